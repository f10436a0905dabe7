"""Source `uci`: boards with Qorvo's UCI firmware on serial ports."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError, format_id
from uwb_mitigation.radios import parameters, port
from uwb_mitigation.radios.capture import Capture
from uwb_mitigation.radios.fira.calibration import OriginalsFile
from uwb_mitigation.radios.fira.codes import EXCHANGE_REMEDIES, UNEXPECTED_CAUSES
from uwb_mitigation.radios.fira.session import UciSession, UciSettings
from uwb_mitigation.radios.settings import PortMessage, Role

DEFAULT_CHANNEL = 9
"""The channel of the configuration that is known from a real board."""

REOPEN_NS = 10 * 10**9
"""Time without an answer after which the port is opened again."""

SHUTDOWN_NS = 10**9
"""Maximum duration of the commands that end the sessions and restore the calibration of a board."""

_MIN_RANGES, _CIR_SHARE = 20, 0.5
_MIN_DAMAGES, _DAMAGE_SHARE = 20, 0.05
_REJECTED = "ranging without the parameters that the board rejected"


@dataclass(frozen=True)
class UciPortSettings(port.StreamSettings):
    """Settings of a UCI board; `board`: what it does."""

    board: UciSettings


def read_settings(value: parameters.ValueReader) -> list[UciPortSettings]:
    """Return the settings of the boards at `port`. The first has the role of the parameter, the others are anchors.

    Raises:
        ParameterError: a setting is invalid; names the parameter.
    """
    ports = [port.PortAddress.parse(text) for text in parameters.read_ports(value)]
    is_tag = value(parameters.PREFIX + "role") == "tag"
    address = (*parameters.read_addresses(value, "address", 0xFFFE), 1 if is_tag else 2)[0]
    local_anchors = tuple(address + number for number in range(1, len(ports)))
    if local_anchors and not is_tag:
        raise ParameterError("several ports and radio.role = anchor", valid="one port, or radio.role = tag")
    anchors = parameters.read_addresses(value, "anchors", 0xFFFE) or local_anchors or (2,)
    tags = parameters.read_addresses(value, "tags", 0xFFFE) or (1,)
    peers = anchors if is_tag else tags
    rate_hz = value(parameters.PREFIX + "rate")
    first = UciSettings(
        role=Role.TAG if is_tag else Role.ANCHOR,
        address=address,
        peers=peers,
        channel=value(parameters.PREFIX + "channel") or DEFAULT_CHANNEL,
        preamble_code=value(parameters.PREFIX + "preamble_code"),
        window=value(parameters.PREFIX + "window"),
        interval_ms=round(1000 * len(peers) / rate_hz) if rate_hz else 0,
        report=value(parameters.PREFIX + "report"),
        sessions=len(peers),
    )
    anchor = replace(first, role=Role.ANCHOR, peers=(address,))
    boards = [first, *(replace(anchor, address=local) for local in local_anchors)]
    for board in boards:
        parameters.check_parameters(board)
    capture = parameters.read_capture(value)
    return [
        UciPortSettings(address, board, capture=capture) for address, board in zip(ports, boards, strict=True)
    ]


def open_capture(path: Path, value: parameters.ValueReader | None = None) -> Capture:
    """Open a capture as a recording; raise RecordingError if it cannot be read."""

    def session(settings: dict[str, Any]) -> UciSession:
        settings.pop("identify", None)  # of earlier versions
        role, peers = Role[settings["role"]], tuple(map(int, settings["peers"]))
        return UciSession(UciSettings(**settings | {"role": role, "peers": peers}))

    return Capture(path, "UCI", session)


class UciPort(port.StreamPort):
    """Operates one board until `close`; starts it again after a loss. See `StreamPort`.

    Events are measurements and `PortMessage`; an anchor delivers its measurements only if its settings request it.
    """

    session: UciSession
    _tick_s = 0.01

    def __init__(self, settings: UciPortSettings, place: port.StreamPlace) -> None:
        self._originals = OriginalsFile(str(settings.address))
        session = UciSession(settings.board, self._originals)
        super().__init__(settings, session, port.ExchangeMonitor(EXCHANGE_REMEDIES, UNEXPECTED_CAUSES), place)
        self._starts = 0
        self._worked_ns = self._stop_ns = 0

    def close(self) -> None:
        """Stop the thread, and close the hardware and the files; may be called twice."""
        super().close()
        self._originals.close()

    def apply(self, settings: UciPortSettings) -> None:
        """Start the board again with other settings.

        Raises:
            ParameterError: the settings are invalid.
        """
        settings.board.check()
        with self._lock:
            if settings.board != self.session.settings:
                self.session.ranging.settings = settings.board
                if self.device:
                    self._opened(time.monotonic_ns())

    @property
    def problem(self) -> str:
        """Reason why the board does not range; empty while it works."""
        with self._lock:
            return self._lost or self.session.state

    def report(self) -> port.PortReport:
        """Return the present state."""
        with self._lock:
            session, s = self.session, self.session.settings
            values: dict[str, object] = {
                "address": format_id(s.address),
                "role": s.role.name.lower(),
                "interval ms": s.effective_interval_ms,
            }
            if session.window is not None:
                values |= {"CIR taps": session.window[0], "CIR taps before the first path": session.window[1]}
            if unit := session.assembly.position_unit.name:
                values["unit of the first-path positions"] = unit
            rejected = session.ranging.rejected_text
            values["rejected parameters"] = rejected or "none"
            values |= {name.replace("_", " "): count for name, count in session.totals().items()}
            values |= {"openings": self.openings}
            hardware = f"UCI board {format_id(s.address)}"
            activity = "ranging" if s.role is Role.TAG else "answering"
            warnings = self._warning(), rejected and f"{_REJECTED}: {rejected}"
            warning = "; ".join(filter(None, warnings))
            return port.PortReport(self.device, hardware, self.problem, warning, activity, values)

    def _warning(self) -> str:
        """Return a possible reason why a board without a problem has no useful ranges, or an empty string."""
        session, counts = self.session, self.session.counts
        totals = session.totals()
        damages = totals["damaged"] + totals["gaps"]
        if damages > max(_MIN_DAMAGES, _DAMAGE_SHARE * counts["ranges"]):
            return (
                f"bytes or notifications are lost between board and host, {damages} times in {counts['ranges']} ranges, "
                f"of which {counts['without_cir']} have no CIR: use another cable or USB port, and stop other programs"
            )
        if not counts["ranges"] and counts["unknown_session"]:
            return "the only ranges are of other addresses: are the ids swapped, or other boards in reach?"
        interval_s = session.settings.effective_interval_ms / 1e3
        if session.settings.delivers and (warning := self.monitor.warning(interval_s)):
            return warning
        if counts["ranges"] >= _MIN_RANGES:
            if counts["without_cir"] > _CIR_SHARE * counts["ranges"]:
                return "most ranges have no CIR: the firmware may not support it; ranges are not corrected"
            if counts["inconsistent_cir"] > _CIR_SHARE * counts["ranges"]:
                return "the reported first path contradicts the samples of most CIRs; they are not used"
            if session.assembly.position_unit.name == "contradictory":
                return "the first-path positions contradict the whole taps, which are used instead"
        return self._originals.problem

    def _opened(self, now_ns: int) -> list[Any]:
        if self._capture is not None:
            settings = self.session.settings
            self._capture.add_board(self._number, asdict(settings) | {"role": settings.role.name})
        self._worked_ns = now_ns
        self.monitor.reset()
        self.session.opened(now_ns)
        return []

    def _received(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Any]:
        session = self.session
        measurements = session.receive(data, now_ns, stamp_ns)
        messages: list[Any] = []
        for cause, count in session.assembly.failures.items():
            self.monitor.add_failures(cause, count, now_ns / 1e9)
        session.assembly.failures.clear()
        if session.starts != self._starts:
            self._starts, self._was_connected = session.starts, True
            messages.append(PortMessage(logging.INFO, self._started_text()))
            if rejected := session.ranging.rejected_text:
                messages.append(PortMessage(logging.WARNING, f"{_REJECTED}: {rejected}"))
        if not session.state or session.is_waiting:
            self._worked_ns = now_ns
        if now_ns - self._worked_ns > REOPEN_NS:
            raise LinkError(session.state, where=self._name)
        return messages + measurements if session.settings.delivers else messages

    def _is_stopped(self, now_ns: int) -> bool:
        with self._lock:
            if not self._stop_ns:
                self._stop_ns = now_ns
                self.session.stop(now_ns)
            return self.session.stopped or now_ns - self._stop_ns > SHUTDOWN_NS

    def _started_text(self) -> str:
        s, window = self.session.settings, self.session.window
        taps = f"{window[0]} taps" if window is not None else "size of the CIR not confirmed"
        return (
            f"UCI board {format_id(s.address)} at {self.device}: {s.role.name.lower()}, channel {s.channel}, "
            f"peers {', '.join(map(format_id, s.peers))}, {s.effective_interval_ms} ms, {taps}"
        )


open = port.stream_opener(UciPort, "UCI")
