"""The settings of a UCI board, and the parameters of its ranging sessions. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.radios.settings import Role

CHANNELS = (5, 9)
PREAMBLE_CODES = (9, 10, 11, 12)
MAX_WINDOW = 255
"""The number of taps of a CIR has one byte."""

MAX_PEERS = 8
MIN_INTERVAL_MS = 14
"""A round has six slots of 2 ms."""

SHORT_INTERVAL_MS, SHORT_WINDOW = 18, 16
"""Default interval of exchanges with a short window."""

TAP_INTERVAL_MS = 0.5
"""Increase of the default interval per further tap: 157 taps take four packets per frame."""

_ROUND_SLOTS, _SLOT_RSTU = 6, 2400
_CIR_METRICS_EMITTER_OFFSET = 0x78


@dataclass(frozen=True, slots=True)
class UciSettings:
    """Settings of a board. Both ends use the same channel, code and interval.

    Attributes:
        role: a tag is controller and initiator, an anchor is controlee and responder.
        address: short address of the board.
        peers: short addresses of the other ends.
        channel: 5 or 9.
        preamble_code: 9 to 12; 0 = 10.
        window: number of CIR taps to request, from 5 before the first path; 0 = no CIR.
        interval_ms: time between two exchanges with the same peer; 0 = the default of the window and of `sessions`.
        report: an anchor also publishes its ranges.
        sessions: number of sessions that share the air.
    """

    role: Role = Role.TAG
    address: int = 1
    peers: tuple[int, ...] = (2,)
    channel: int = 9
    preamble_code: int = 0
    window: int = 157
    interval_ms: int = 0
    report: bool = False
    sessions: int = 1

    def check(self) -> None:
        """Raise ParameterError, with the name of the setting, for an invalid value."""
        for address in (self.address, *self.peers):
            if not 0 < address < 0xFFFF:
                raise ParameterError(f"address = {address}", valid="1 to 65534")
        if not 1 <= len(self.peers) <= MAX_PEERS or self.address in self.peers:
            raise ParameterError(f"peers = {list(self.peers)}", valid=f"1 to {MAX_PEERS} other addresses")
        if self.channel not in CHANNELS:
            raise ParameterError(f"channel = {self.channel}", valid="5 or 9")
        if self.preamble_code and self.preamble_code not in PREAMBLE_CODES:
            raise ParameterError(f"preamble_code = {self.preamble_code}", valid="9 to 12, or 0")
        if not 0 <= self.window <= MAX_WINDOW:
            raise ParameterError(f"window = {self.window}", valid=f"0 to {MAX_WINDOW}")
        if self.interval_ms and not MIN_INTERVAL_MS <= self.interval_ms <= 0xFFFF:
            valid = f"{MIN_INTERVAL_MS} to 65535: at most 71 exchanges per second"
            raise ParameterError(f"interval_ms = {self.interval_ms}", valid=valid)

    @property
    def effective_interval_ms(self) -> int:
        """Interval of each session."""
        if self.interval_ms:
            return self.interval_ms
        extra = max(0, self.window - SHORT_WINDOW)
        return max(self.sessions, len(self.peers)) * round(SHORT_INTERVAL_MS + TAP_INTERVAL_MS * extra)

    @property
    def delivers(self) -> bool:
        """Whether the ranges of this board are published; those of an anchor only if requested."""
        return self.role is Role.TAG or self.report

    def session_id(self, peer: int) -> int:
        """Return the number of the session with a peer; it is the same at both ends."""
        tag, anchor = (self.address, peer) if self.role is Role.TAG else (peer, self.address)
        return tag << 16 | anchor

    def app_config(self, peer: int) -> list[tuple[int, bytes]]:
        """Return the parameters of a session, {tag, value}: those that worked on a real board, in their order."""
        is_tag = self.role is Role.TAG
        on, off = b"\1", b"\0"
        return [
            (0x00, on if is_tag else off),  # device type: controller, controlee
            (0x11, on if is_tag else off),  # device role: initiator, responder
            (0x03, off),  # unicast
            (0x01, b"\2"),  # DS-TWR, deferred
            (0x06, struct.pack("<H", self.address)),
            (0x04, bytes([self.channel])),
            (0x22, on),  # time-scheduled
            (0x02, off),  # static STS
            (0x12, b"\3"),  # SP3
            (0x2E, b"\x0b"),  # result report
            (0x27, b"\x08\x07"),  # vendor id
            (0x28, b"\1\2\3\4\5\6"),  # static STS IV
            (0x0D, on),  # AoA request
            (0x2B, bytes(8)),  # initiation time
            (0x14, bytes([self.preamble_code or 10])),
            (0x15, b"\2"),  # SFD
            (0x08, struct.pack("<H", _SLOT_RSTU)),
            (0x09, struct.pack("<I", self.effective_interval_ms)),
            (0x1B, bytes([_ROUND_SLOTS])),
            (0x32, bytes(2)),  # no limit of measurements
            (0x2C, off),  # no hopping
            (0x13, off),  # RSSI: part of the diagnostics
            (0x2D, off),  # block stride
            (0x05, on),  # controlees
            (0x07, struct.pack("<H", peer)),
            (0x24, off),  # key rotation rate
            (0x35, on),  # STS length
            (0xE8, on),  # diagnostics
            (0xE9, bytes([_CIR_METRICS_EMITTER_OFFSET])),
        ]
