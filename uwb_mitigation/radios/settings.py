"""The settings and the status of a radio, and their texts for users. No I/O."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

from uwb_mitigation.errors import ParameterError, format_id


@dataclass(frozen=True, slots=True)
class PortMessage:
    """A text for the log; `level` is one of `logging`."""

    level: int
    text: str


class Role(enum.IntEnum):
    """Role of a board's radio."""

    TAG = 0
    """Starts exchanges with one anchor after the other."""
    ANCHOR = 1
    """Answers the exchanges of tags."""


class RadioState(enum.IntEnum):
    """Whether a board's radio works."""

    RUNNING = 0
    BUS = 1
    """The bus between chip and processor has failed."""
    ABSENT = 2
    """No DW1000 answers."""
    NO_CLOCK = 3
    """The clock PLL does not lock: the chip ignores SPI at full speed."""
    RESTARTED = 4
    """The chip was reset and is being configured again."""
    LOCK_UNCONFIRMED = 5
    """The chip works, but did not report the lock of its clock PLL (errata: the report is not reliable)."""


MAX_ANCHORS = 32
"""Maximum number of anchors that a tag polls."""

CHANNELS = (1, 2, 3, 4, 5, 7)
PREAMBLES = (64, 128, 256, 512, 1024, 1536, 2048, 4096)
RATES_KBPS = (110, 850, 6800)
PRFS_MHZ = (16, 64)
AGE_UNKNOWN_MS = 0xFFFFFFFF
"""`AnchorStatus.age_ms` of an anchor that was never received."""


@dataclass(frozen=True, slots=True)
class RadioSettings:
    """Settings of a radio. Both ends of a link must use the same channel, PRF, code, rate, delimiter and PAN.

    `wire.layout` describes the fields, in the same order, and their units. 0 in `tx_power` and `antenna_delay` means the value of
    the OTP memory (of a TREK1000 board the delay for this role, channel and rate), and otherwise the manual's, or 2 x 16436 ticks;
    0 in `reply_us` and `timeout_us` means the default for the tag's bus and processor, plus the duration of long frames.
    `window` counts complex samples from 5 before the first path. The models were trained without `bias_correction`.
    """

    address: int = 0
    antenna_delay: int = 0
    tx_power: int = 0
    reply_us: int = 0
    timeout_us: int = 0
    interval_us: int = 0
    pan: int = 0x5542
    rate_kbps: int = 6800
    preamble: int = 128
    window: int = 157
    channel: int = 5
    prf_mhz: int = 64
    preamble_code: int = 0
    decawave_sfd: bool = False
    role: Role = Role.TAG
    report: bool = False
    bias_correction: bool = False
    anchors: tuple[int, ...] = ()

    def check(self) -> None:
        """Raise ParameterError, with the name of the setting, for an invalid value."""
        _one_of("channel", self.channel, CHANNELS)
        _one_of("prf_mhz", self.prf_mhz, PRFS_MHZ)
        _one_of("preamble", self.preamble, PREAMBLES)
        _one_of("rate_kbps", self.rate_kbps, RATES_KBPS)
        if self.preamble_code:
            _one_of("preamble_code", self.preamble_code, preamble_codes(self.channel, self.prf_mhz))
        _within("address", self.address, 0, 2**64 - 2)
        _within("pan", self.pan, 0, 0xFFFE)
        _within("tx_power", self.tx_power, 0, 0xFFFFFFFF)
        _within("antenna_delay", self.antenna_delay, 0, 0x1FFFE)
        _within("window", self.window, 0, 0xFFFF)
        if self.reply_us:
            # Smart power allows one frame per millisecond; it exists at 6.8 Mbit/s only.
            _within("reply_us", self.reply_us, 1000 if self.rate_kbps == 6800 else 200, 100_000)
        if self.timeout_us:
            _within("timeout_us", self.timeout_us, 400, 500_000)
        _within("interval_us", self.interval_us, 0, 60_000_000)
        _within("anchors", len(self.anchors), 0, MAX_ANCHORS)
        for anchor in self.anchors:
            _within("anchors", anchor, 1, 2**64 - 2)

    @property
    def text(self) -> str:
        """The settings as text for the log."""
        return (
            f"{self.role.name.lower()}, channel {self.channel}, {self.rate_kbps} kbit/s, preamble {self.preamble}, "
            f"PAN 0x{self.pan:04x}"
        )


DEFAULT_RADIO = RadioSettings()


@dataclass(frozen=True, slots=True)
class AnchorStatus:
    """Exchanges of a tag with one anchor; the fields of `layout.RADIO_ANCHOR`, in the same order."""

    address: int
    tried: int
    ranged: int
    rx_power_dbm: float
    age_ms: int


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """State, and counts since the board's start; the fields of `layout.PAYLOADS[RADIO_STATUS]`.

    Attributes:
        REMEDIES: {cause of a failed exchange: what to do}; the causes are the names of counts.
    """

    REMEDIES: ClassVar[Mapping[str, str]] = {
        "no answer": "no anchor answers: check their power, channel, data rate and PAN id",
        "late": "this computer is too slow for radio.reply_us: stop other programs",
        "timeout": "the frames of the anchors do not arrive in time: all radios need the same firmware and settings",
        "damaged": "damaged frames: other radios transmit on this channel, or the signal is weak",
        "implausible": "the antennas are too close, or the antenna delays are wrong",
        "broken": "the radio was reset or its bus failed: check supply and wiring",
    }

    tried: int = 0
    ranged: int = 0
    no_answer: int = 0
    late: int = 0
    timeout: int = 0
    damaged: int = 0
    implausible: int = 0
    broken: int = 0
    refused: int = 0
    restarts: int = 0
    temperature_c: float = math.nan
    voltage: float = math.nan
    state: RadioState = RadioState.RUNNING
    anchors: tuple[AnchorStatus, ...] = ()

    @property
    def problem(self) -> str:
        """Why the radio does not work; empty if it does, or may."""
        return _STATE_PROBLEMS.get(self.state, "")

    @property
    def warning(self) -> str:
        """The warning of a radio whose state is not certain; empty if it is."""
        if self.state is RadioState.LOCK_UNCONFIRMED:
            return "the DW1000 has not reported that its clock PLL locked; if it does not range, check its supply"
        return ""

    def values(self, settings: RadioSettings | None, prefix: str = "") -> dict[str, object]:
        """Return the values of a radio and of its anchors for the diagnostics."""
        values: dict[str, object] = {}
        if settings is not None:
            values = {
                "address": format_id(settings.address),
                "role": settings.role.name.lower(),
                "antenna delay": settings.antenna_delay,
            }
        counts = (row.name for row in fields(RadioStatus) if row.type == "int")
        values |= {name.replace("_", " "): getattr(self, name) for name in counts}
        values |= {"temperature C": f"{self.temperature_c:.1f}", "voltage V": f"{self.voltage:.2f}"}
        values = {f"{prefix}{name}": value for name, value in values.items()}
        for anchor in self.anchors:
            last_seen = "never" if anchor.age_ms == AGE_UNKNOWN_MS else f"{anchor.age_ms / 1000:.1f} s ago"
            values[f"anchor {format_id(anchor.address)}"] = (
                f"{anchor.ranged} of {anchor.tried} ranged, {anchor.rx_power_dbm:.1f} dBm, last seen {last_seen}"
            )
        return values


_STATE_PROBLEMS = {
    RadioState.ABSENT: "no DW1000 answers: check wiring and supply",
    RadioState.BUS: "the SPI of the DW1000 fails",
    RadioState.NO_CLOCK: "the clock PLL of the DW1000 does not lock: check its supply",
}


def preamble_codes(channel: int, prf_mhz: int) -> range:
    """Return the preamble codes of IEEE 802.15.4 for a channel and a PRF of 16 or 64 MHz."""
    if prf_mhz == 64:
        return range(17, 21) if channel in (4, 7) else range(9, 13)
    first = {1: 1, 2: 3, 3: 5, 4: 7, 5: 3, 7: 7}[channel]
    return range(first, first + 2)


def _one_of(name: str, value: int, allowed: tuple[int, ...] | range) -> None:
    if value not in allowed:
        raise ParameterError(f"radio setting {name} = {value}", valid=", ".join(map(str, allowed)))


def _within(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ParameterError(f"radio setting {name} = {value}", valid=f"{low} to {high}")
