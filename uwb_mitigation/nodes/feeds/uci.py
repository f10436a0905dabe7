"""Feed of the driver for boards with UCI firmware."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import ParameterError, format_id, parse_id
from uwb_mitigation.nodes.feeds.radios import PREFIX, LiveFeed, Value, level_of
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.radios.fira.capture import CaptureWriter
from uwb_mitigation.radios.fira.session import UciSettings
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.radios.uci import UciDriver, UciReport, UciStarted
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.offsets import Offsets

DEFAULT_CHANNEL = 9
"""The channel of the configuration that is known from a real board."""


def uci_settings(value: Value) -> list[UciSettings]:
    """Return the settings of the boards at `port`. The first has the role of the parameter, the others are anchors.

    Raises:
        ParameterError: a setting is invalid; names the parameter.
    """

    def addresses(name: str) -> tuple[int, ...]:
        parts = [part.strip() for part in str(value(PREFIX + name)).split(",")]
        try:
            return tuple(parse_id(part) for part in parts if part)
        except ValueError:
            raise ParameterError(
                f"parameter {PREFIX}{name} = {value(PREFIX + name)!r:.40}", valid="1 to 65534"
            ) from None

    is_tag = value(PREFIX + "role") == "tag"
    address = (*addresses("address"), 1 if is_tag else 2)[0]
    local_anchors = tuple(address + number for number in range(1, len(_ports(value))))
    if local_anchors and not is_tag:
        raise ParameterError("several ports and radio.role = anchor", valid="one port, or radio.role = tag")
    anchors = addresses("anchors") or local_anchors or (2,)
    tags = addresses("tags") or (1,)
    rate_hz = value(PREFIX + "rate")
    try:
        boards = []
        for number, own in enumerate((address, *local_anchors)):
            peers = (address,) if number else anchors if is_tag else tags
            sessions = len(anchors if is_tag else tags)
            board = UciSettings(
                Role.TAG if is_tag and not number else Role.ANCHOR,
                own,
                peers,
                value(PREFIX + "channel") or DEFAULT_CHANNEL,
                value(PREFIX + "preamble_code"),
                value(PREFIX + "window"),
                round(1000 * sessions / rate_hz) if rate_hz else 0,
                value(PREFIX + "report"),
                sessions,
            )
            board.check()
            boards.append(board)
        return boards
    except ParameterError as error:
        raise ParameterError(f"parameters {PREFIX}*: {error.what}", valid=error.valid) from error


def _ports(value: Value) -> list[str]:
    return [part.strip() for part in value("port").split(",") if part.strip()]


class UciFeed(LiveFeed):
    """Publishes the ranges of UCI boards, and logs their problems.

    Args:
        value: returns a parameter's value.
        on_range, now_ns, logger: see `LiveFeed`.

    Raises:
        ParameterError: a port, a setting or the file of the capture is invalid.
    """

    _ports: list[UciDriver]

    def __init__(
        self,
        value: Value,
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        settings = uci_settings(value)
        # Without a port, parsing fails with the valid formats.
        places = [PortAddress.parse(name) for name in _ports(value) or [""]]
        self._capture = CaptureWriter(Path(value("capture")).expanduser()) if value("capture") else None
        with ExitStack() as started:
            drivers = []
            for number, (place, board) in enumerate(zip(places, settings, strict=True)):
                driver = UciDriver(place, board, stamp_clock=now_ns, capture=self._capture, number=number)
                started.callback(driver.close)
                drivers.append(driver)
            started.pop_all()
        super().__init__(drivers, on_range, now_ns, logger)

    def stop(self) -> None:
        super().stop()
        if self._capture is not None:
            self._capture.close()

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Start the boards again with new settings."""
        if any(name.startswith(PREFIX) for name in changed):
            for driver, settings in zip(self._ports, uci_settings(value), strict=True):
                driver.set_settings(settings)

    def describe(self) -> Description:
        reports = [driver.report() for driver in self._ports]
        values: dict[str, object] = {"ranges published": self.ranges} | self.meter.entries()
        for number, report in enumerate(reports):
            prefix = f"board {number}: " if len(reports) > 1 else ""
            values |= {f"{prefix}{name}": value for name, value in _values(report).items()}
        problem = "; ".join(report.problem for report in reports if report.problem)
        hardware = f"UCI board {format_id(reports[0].settings.address)}"
        warning = next(filter(None, map(_warning, reports)), "")
        return hardware, *level_of(problem, warning, "ranging"), values

    def handle(self, event: UciStarted, port: UciDriver) -> None:
        s, window = event.settings, event.window
        taps = f"{window[0]} taps" if window is not None else "size of the CIR not confirmed"
        self._logger.info(
            f"UCI board {format_id(s.address)} at {port.report().port}: {s.role.name.lower()}, channel {s.channel}, "
            f"peers {', '.join(map(format_id, s.peers))}, {s.effective_interval_ms} ms, {taps}"
        )


def _values(report: UciReport) -> dict[str, object]:
    values: dict[str, object] = {
        "port": report.port or "none",
        "address": format_id(report.settings.address),
        "role": report.settings.role.name.lower(),
        "interval ms": report.settings.effective_interval_ms,
    }
    if report.window is not None:
        values |= {"CIR taps": report.window[0], "CIR taps before the first path": report.window[1]}
    return values | {name.replace("_", " "): count for name, count in report.counts.items()}


def _warning(report: UciReport) -> str:
    """Return a possible reason why a board without a problem has no useful ranges, or an empty string."""
    counts = report.counts
    if not counts["ranges"] and counts["unknown_session"]:
        return "the only ranges are of other addresses: are the ids swapped, or other boards in reach?"
    exchanges = counts["joined"] + counts["without_diagnostics"]
    if not counts["ranges"] and 2 * counts.get("transmission_failed", 0) > exchanges:
        return "the board cannot transmit: load its calibration again, as after a chip erase"
    if report.settings.role is Role.TAG and not counts["ranges"]:
        return "no range yet: are the anchors on, with the same channel, addresses and interval?"
    if counts["ranges"] >= 20 and counts["without_cir"] > counts["ranges"] / 2:
        return "most ranges have no CIR: the firmware may not support it; ranges are not corrected"
    if counts["ranges"] >= 20 and counts["inconsistent_cir"] > counts["ranges"] / 2:
        return "the reported first path contradicts the samples of most CIRs; they are not used"
    if report.rejected:
        tags = ", ".join(f"0x{tag:02x}" for tag in sorted(report.rejected))
        return f"ranging without the parameters that the board rejected: {tags}"
    return ""
