"""The text format of Decawave's DecaRanging PC program (EVK1000): exchanges out of the lines of a log.

As seen from the anchor, one exchange is: a poll received, a response sent, a final received, and the
range. Of each frame received the log holds the frame (`RX DATA`), the diagnostics (`RX OK`) and the
whole accumulator; of a reception in error (`RX E`) an accumulator too, which belongs to no exchange.

The format is known from recordings alone (doi 10.5281/zenodo.4742391, DecaRanging 3.05). Times are
taken from the 40-bit receive stamp only, never from the seconds printed beside it. A first path far
into the accumulator (above index 790) is as good as any: the whole response is shifted.
"""

from __future__ import annotations

import enum
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone

import numpy as np

from uwb_mitigation.measurement import DEVICE_TICK_HZ, DEVICE_TIME_WRAP, Cir, RangeMeasurement
from uwb_mitigation.sources.log_lines import LogLines

MAX_ACCUMULATOR = 1016
"""Samples of the accumulator at 64 MHz PRF; 992 at 16 MHz (DW1000 user manual, section 7.2.38)."""


POLL_CODE = 0x21
FINAL_CODE = 0x29
"""Function codes of the frames that an anchor receives: the byte after the addresses."""


class CirOf(str, enum.Enum):
    """Which frame's CIR goes with the range of an exchange.

    FINAL: the last frame received before the range is reported, whose reception time stamps the
    exchange. POLL: the first one.
    """

    POLL = "poll"
    FINAL = "final"


class Oddity(str, enum.Enum):
    """What is counted in `skipped`."""

    RECEPTION_ERROR = "reception in error (RX E)"
    RECEPTION_ERROR_CODED = "reception in error, with a code (RX EC)"
    RETRIED_POLL = "poll retried"
    TRANSMIT_AFTER_FINAL = "transmit line after the final frame"
    NO_RANGE = "exchange without a range"
    UNFINISHED = "log ends in the middle of an exchange"
    RANGE_BEFORE_FRAMES = "range before any frame (no CIR)"
    RANGE_WITHOUT_CIR = "range whose frame has no CIR"
    RANGE_NOT_A_NUMBER = "range that is not a number"
    POWER_NOT_A_NUMBER = "power that is not a number"
    FIRST_PATH_NOT_A_NUMBER = "first path that is not a number"
    FIRST_PATH_OUTSIDE = "first path outside the accumulator"
    BAD_ACCUMULATOR = "accumulator that is malformed"
    BAD_FRAME = "frame line that is malformed"
    OTHER_FRAME = "frame that is neither poll nor final"
    BAD_HEADER = "header without channel and PRF"
    NO_START_TIME = "log without a start time"
    UNKNOWN_LINE = "line that is not known"
    NO_TRUTH = "log without surveyed truth"
    MOVED = "log moved later, not to overlap the one before"
    TWICE = "log present both plain and compressed"
    UNREADABLE = "log that could not be read to its end"


_FILE = re.compile(rb"File:(\d{8}-\d{6})")
_MODE = re.compile(rb"Mode: .*?Chan ([1-7]), .*?PRF (16|64),")
_FRAME = re.compile(rb"RX DATA: ?((?:[0-9A-Fa-f]{2}){22,1024})")
_RX_OK = re.compile(
    rb"RX OK .*?HLP\(([^()]*)\), PSC\((\d{1,4})\), .*?RC\(([0-9A-F]{1,4}) ([0-9A-F]{8})\), "
    rb".*?NTH\(([0-9A-F]{1,4})\), .*?RSL\(([^()]*)\), FSL\(([^()]*)\), .*\)"
)
_RANGE = re.compile(rb"Anchor ToF: .*?Dist: (\S+) m .* ppm")
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_UNUSED = re.compile(rb"(?:[0-9A-F]{2} )?[0-9A-F]{2} [RT]x time|txdly |   Adding Antenna Delay|R[ab]1? |$")
_KNOWN = re.compile(rb"File:|Mode: |RX |Accum Len|TX Frame|Anchor ToF|" + _UNUSED.pattern)
_ACCUMULATOR = re.compile(rb"Accum Len (\d{1,9})")
_IS_LOG = re.compile(rb"(?m)^(?:File:.*DecaRanging|Mode: \d+, Chan |RX DATA:|RX OK |Anchor ToF: )")

_NO_SAMPLES = np.zeros(0, np.int16)
_NO_SAMPLES.setflags(write=False)
_FLOAT32_MAX = float(np.finfo(np.float32).max)
_FIRST_PATH_MAX = 1024 - 2**-6  # FP_INDEX has ten bits before the point and six after
_DBM_MAX = 1000.0


def is_log(head: bytes) -> bool:
    """Whether a log of DecaRanging can begin like this."""
    return _IS_LOG.search(head) is not None


def stated_start_ns(head: bytes) -> int:
    """The start time in a log's first line, taken as UTC, ns since the epoch; 0 where it states none."""
    stated = _FILE.match(head)
    if stated is None:
        return 0
    try:
        start = datetime.strptime(stated[1].decode(), "%Y%m%d-%H%M%S").replace(tzinfo=timezone.utc)
    except ValueError:
        return 0
    # The counters of ROS and numpy end in 2262.
    return int(start.timestamp()) * 1_000_000_000 if 1970 <= start.year < 2262 else 0


def _finite(text: bytes, low: float, high: float) -> float:
    """The number that `text` is, or NaN: not one (such as `-001.#INF`), or not from low to high."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if low <= value <= high else math.nan


@dataclass(slots=True)
class _Frame:
    """A frame received; the log gives the samples of its CIR after the rest."""

    device_time: int
    cir: Cir


@dataclass(slots=True)
class ExchangeReader:
    """Follows the exchanges through the lines of one log.

    Attributes:
        lines: the log, from its first line.
        skipped: where oddities are counted.
        cir_of: which frame's CIR belongs to the range.
        tag_id, anchor_id: in place of the addresses in the frames.
        sequence: of the next exchange.
        not_before_ns: the log's clock starts no earlier, whatever its first line states.
    """

    lines: LogLines
    skipped: Counter[str]
    cir_of: CirOf = CirOf.FINAL
    tag_id: int | None = None
    anchor_id: int | None = None
    sequence: int = 0
    not_before_ns: int = 0
    base_ns: int = 0
    channel: int = 0
    prf_mhz: int = 0
    ticks: int = 0  # from the first frame to the latest
    latest: int | None = None  # device time of the latest frame
    addresses: tuple[int, int] = (0, 0)  # tag, anchor
    announced: int | None = None  # function code in the latest RX DATA
    owner: _Frame | None = None  # the frame that a dump now would belong to
    frames: dict[int, _Frame] = field(default_factory=dict)  # of this exchange, by function code

    def measurements(self) -> Iterator[RangeMeasurement]:
        """Yield a measurement for each range that the log reports, with or without a CIR.

        Raises:
            DamagedRecordingError: the log ends in the middle of a line or of an accumulator.
        """
        stated_ns = stated_start_ns(self.lines.head())
        if stated_ns == 0:
            self._count(Oddity.NO_START_TIME)
        self.base_ns = max(stated_ns, self.not_before_ns)
        while (line := self.lines.take()) is not None:
            if line.startswith(b"Accum Len"):
                self._accumulator(line)
            elif line.startswith(b"RX DATA"):
                self._announce(line)
            elif line.startswith(b"RX OK"):
                self._receive(line)
            elif line.startswith(b"Anchor ToF"):
                yield self._range(line)
            elif line.startswith(b"RX E"):
                self._abandon()
                coded = line.startswith(b"RX EC")
                self._count(Oddity.RECEPTION_ERROR_CODED if coded else Oddity.RECEPTION_ERROR)
            elif line.startswith(b"TX Frame"):
                if FINAL_CODE in self.frames:
                    self._count(Oddity.TRANSMIT_AFTER_FINAL)
            elif line.startswith(b"Mode: "):
                self._header(line)
            elif not (_UNUSED.match(line) or (line.startswith(b"File:") and self.lines.number == 1)):
                self._count(Oddity.UNKNOWN_LINE)
        if self.channel == 0:
            self._count(Oddity.BAD_HEADER)
        if self.frames or self.announced is not None:
            self._count(Oddity.UNFINISHED)

    def _count(self, oddity: Oddity) -> None:
        self.skipped[oddity.value] += 1

    def _header(self, line: bytes) -> None:
        mode = _MODE.match(line)
        if mode is not None:
            self.channel, self.prf_mhz = int(mode[1]), int(mode[2])

    def _abandon(self) -> None:
        """Leave what was begun of a frame."""
        if self.announced is not None:
            self._count(Oddity.BAD_FRAME)
        self.owner = self.announced = None

    def _announce(self, line: bytes) -> None:
        """Take the frame itself: IEEE 802.15.4 with 64-bit addresses, then the function code."""
        self._abandon()
        match = _FRAME.fullmatch(line)
        if match is None:
            self._count(Oddity.BAD_FRAME)
            return
        frame = bytes.fromhex(match[1].decode())
        self.announced = frame[21]
        self.addresses = int.from_bytes(frame[13:21], "little"), int.from_bytes(frame[5:13], "little")

    def _receive(self, line: bytes) -> None:
        """Take a frame's diagnostics; what dump follows belongs to it."""
        code, self.announced, self.owner = self.announced, None, None
        match = _RX_OK.fullmatch(line)
        if match is None or code is None:
            self._count(Oddity.BAD_FRAME)
            return
        device_time = ((int(match[3], 16) << 32) | int(match[4], 16)) % DEVICE_TIME_WRAP
        if self.latest is not None:
            self.ticks += (device_time - self.latest) % DEVICE_TIME_WRAP
        self.latest = device_time
        if code == POLL_CODE:
            if FINAL_CODE in self.frames:
                self._count(Oddity.NO_RANGE)
            elif self.frames:
                self._count(Oddity.RETRIED_POLL)
            self.frames.clear()
        elif code != FINAL_CODE:
            self._count(Oddity.OTHER_FRAME)
            return
        elif code in self.frames:
            self._count(Oddity.NO_RANGE)

        first_path = _finite(match[1], 0.0, _FIRST_PATH_MAX)
        powers = _finite(match[6], -_DBM_MAX, _DBM_MAX), _finite(match[7], -_DBM_MAX, _DBM_MAX)
        if math.isnan(first_path):
            self._count(Oddity.FIRST_PATH_NOT_A_NUMBER)
        if math.isnan(powers[0]) or math.isnan(powers[1]):
            self._count(Oddity.POWER_NOT_A_NUMBER)
        self.owner = self.frames[code] = _Frame(
            device_time,
            Cir(
                _NO_SAMPLES,
                first_path_index=first_path,
                preamble_count=int(match[2]),
                noise_threshold=int(match[5], 16),
                rx_power_dbm=powers[0],
                first_path_power_dbm=powers[1],
                channel=self.channel,
                prf_mhz=self.prf_mhz,
            ),
        )

    def _accumulator(self, line: bytes) -> None:
        owner, self.owner = self.owner, None
        match = _ACCUMULATOR.fullmatch(line)
        length = int(match[1]) if match is not None else 0
        if not 1 <= length <= MAX_ACCUMULATOR:
            self._count(Oddity.BAD_ACCUMULATOR)
            self._pass_over(None)
            return
        samples = self.lines.pairs(length)
        if samples is None:
            # Cut short by the log's end, or malformed: the exchange goes on without it.
            self._pass_over(length)
            self._count(Oddity.BAD_ACCUMULATOR)
            return
        if owner is None:
            return
        samples.setflags(write=False)
        owner.cir = replace(owner.cir, samples=samples)
        if owner.cir.first_path_index >= length:
            self._count(Oddity.FIRST_PATH_OUTSIDE)

    def _pass_over(self, count: int | None) -> None:
        """Take lines up to one that is known, `count` at most."""
        taken = 0
        while taken != count:
            line = self.lines.take()
            if line is None:
                if count is not None:
                    raise self.lines.damaged(f"the log ends after {taken} of {count} accumulator lines")
                return
            if _KNOWN.match(line):
                self.lines.give_back(line)
                return
            taken += 1

    def _range(self, line: bytes) -> RangeMeasurement:
        match = _RANGE.fullmatch(line)
        range_m = _finite(match[1], -_FLOAT32_MAX, _FLOAT32_MAX) if match is not None else math.nan
        if math.isnan(range_m):
            self._count(Oddity.RANGE_NOT_A_NUMBER)
        self._abandon()
        frame = self.frames.get(FINAL_CODE if self.cir_of is CirOf.FINAL else POLL_CODE)
        if not self.frames:
            self._count(Oddity.RANGE_BEFORE_FRAMES)
        elif frame is None or len(frame.cir) == 0:
            self._count(Oddity.RANGE_WITHOUT_CIR)
        self.frames.clear()
        if frame is None:
            frame = _Frame(self.latest or 0, Cir(_NO_SAMPLES, channel=self.channel, prf_mhz=self.prf_mhz))
        sequence, self.sequence = self.sequence, self.sequence + 1
        tag, anchor = self.addresses
        return RangeMeasurement(
            stamp_ns=self.base_ns + self.ticks * 1_000_000_000 // int(DEVICE_TICK_HZ),
            tag_id=tag if self.tag_id is None else self.tag_id,
            anchor_id=anchor if self.anchor_id is None else self.anchor_id,
            sequence=sequence & 0xFFFFFFFF,
            device_time=frame.device_time,
            range_m=range_m,
            cir=frame.cir,
        )
