"""The host's state of a UCI board: start-up, ranging sessions, measurements. No I/O.

A `UciSession` takes received bytes and the time, and returns measurements and bytes to send. One ranging session is
opened for each peer: FiRa double-sided two-way ranging (deferred), SP3 frames, unicast.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Generator, Mapping
from dataclasses import dataclass

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.radios.fira import messages
from uwb_mitigation.radios.fira.cir import read_cir
from uwb_mitigation.radios.fira.joining import DiagnosticsMatcher, MatchedRange, RangeArrival
from uwb_mitigation.radios.fira.messages import (
    DEVICE_READY,
    RANGE_STATUSES,
    STATUS_OK,
    Diagnostics,
    MessageType,
    RangeNotification,
    SessionState,
)
from uwb_mitigation.radios.fira.packets import Message, PacketDecoder, encode
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.types.measurement import RangeMeasurement

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

_MS = 10**6
ANSWER_NS = 500 * _MS
"""Timeout of a command."""

RESET_NS = 150 * _MS
"""Timeout of a reset, which a board that is starting ignores."""

RESET_TRIES = 5
"""Number of resets after which a board that refuses them is used without."""

READY_NS = 600 * _MS
"""Timeout of the notification that a board is ready after a reset; it ignores commands before."""

TRIES = 3
RETRY_NS = 300 * _MS
"""Time after which a start that failed is repeated."""

SILENCE_NS = 1500 * _MS
"""Time without a notification, in addition to five intervals, after which the host asks whether the board works."""

MAX_OUTGOING_BYTES = 1 << 14

_TAPS, _LEAD = "rx_diag_config.cir_n_taps", "rx_diag_config.cir_fp_tap_offset"
_ROUND_SLOTS, _SLOT_RSTU = 6, 2400
_ENABLE_DIAGNOSTICS, _DIAGNOSTICS_MASK = 0xE8, 0xE9
_CIR_METRICS_EMITTER_OFFSET = 0x78
_NEEDED = frozenset((0x00, 0x06, 0x07, 0x11))
"""Parameters without which a session cannot range: role and addresses."""


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
        identify: ask the board for its device information after the start.
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
    identify: bool = False

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
            raise ParameterError(
                f"interval_ms = {self.interval_ms}",
                valid=f"{MIN_INTERVAL_MS} to 65535: at most 71 exchanges per second",
            )

    @property
    def effective_interval_ms(self) -> int:
        """Interval of each session."""
        if self.interval_ms:
            return self.interval_ms
        extra = max(0, self.window - SHORT_WINDOW)
        return max(self.sessions, len(self.peers)) * round(SHORT_INTERVAL_MS + TAP_INTERVAL_MS * extra)

    def session_id(self, peer: int) -> int:
        """Return the number of the session with a peer; it is the same at both ends."""
        tag, anchor = (self.address, peer) if self.role is Role.TAG else (peer, self.address)
        return tag << 16 | anchor


@dataclass(slots=True)
class _Command:
    """A command, or a wait for the device to be ready if it has no name."""

    name: tuple[int, int] | None
    payload: bytes = b""
    tries: int = TRIES
    timeout_ns: int = ANSWER_NS
    left: int = 0
    due_ns: int = 0


_Steps = Generator[_Command, Message | None, str]


class UciSession:
    """The host's side of one board.

    Call `receive` after each read, and at least every 50 ms; send `outgoing`. `now_ns` is monotonic, `stamp_ns` is
    the clock of the stamps.

    Args:
        settings: what the board does.

    Attributes:
        state: problem, or an empty string while the board ranges.
        window: number of taps and lead that the board has confirmed; None = it did not answer.
        rejected: parameters that the board did not accept, {tag: status}.
        device_info: answer of the board to the request for its identity, not decoded.
        counts: numbers of messages, ranges and problems.
        starts: how often ranging was started.
        clock_offsets_ppm: latest carrier frequency offsets of the peers.
    """

    def __init__(self, settings: UciSettings) -> None:
        settings.check()
        self.settings = settings
        self.state = "not connected"
        self.window: tuple[int, int] | None = None
        self.rejected: dict[int, int] = {}
        self.device_info = b""
        self.starts = 0
        self.counts: Counter[str] = Counter(
            ranges=0, without_cir=0, inconsistent_cir=0, unknown_session=0, restarts=0, error_answers=0
        )
        self.clock_offsets_ppm: deque[float] = deque(maxlen=200)
        self._decoder = PacketDecoder()
        self._joined_before: Counter[str] = Counter(DiagnosticsMatcher(0).counts)
        self._outgoing = bytearray()
        self._steps: _Steps | None = None
        self._pending: _Command | None = None
        self._handles: dict[int, int] = {}
        self._handle_of: dict[int, int] = {}
        self._joiners: dict[int, DiagnosticsMatcher] = {}
        self._active: set[int] = set()
        self._ready = False
        self._boot_due = False
        self._has_ranged = False
        self._received_ns = self._ended_ns = 0
        self._asked = False

    def opened(self, now_ns: int) -> None:
        """Start the board after its port was opened."""
        self._decoder.reset()
        self._outgoing.clear()
        self._begin(now_ns)

    def closed(self) -> None:
        """Stop after the port was lost."""
        self._steps = self._pending = None
        self._outgoing.clear()
        self._end_sessions()
        self.state = "not connected"

    def outgoing(self) -> bytes:
        """Return the bytes to send, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def stop_commands(self) -> bytes:
        """Return the commands that end all sessions, to be sent before the port is closed."""
        handles = [struct.pack("<I", handle) for handle in self._handles]
        return b"".join(
            encode(*name, handle)
            for handle in handles
            for name in (messages.RANGE_STOP, messages.SESSION_DEINIT)
        )

    def totals(self) -> dict[str, int]:
        """Return all counts for diagnostics, {name: count}."""
        joined = Counter(self._joined_before)
        for joiner in self._joiners.values():
            joined.update(joiner.counts)
        return {**self.counts, **joined, **self._decoder.counts}

    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        """Handle received bytes and timeouts; return new measurements."""
        found: list[RangeMeasurement] = []
        for message in self._decoder.feed(data, now_ns):
            found += self._handle(message, now_ns, stamp_ns)
        for handle, joiner in self._joiners.items():
            found += self._measurements(handle, joiner.expire(now_ns))
        self._check_times(now_ns)
        return found

    def _begin(self, now_ns: int) -> None:
        self._end_sessions()
        self.state = "no answer to the reset: is this a board with UCI firmware?"
        self._steps = self._start_up()
        self._received_ns = now_ns
        self._asked = self._has_ranged = False
        self._advance(None, now_ns)

    def _end_sessions(self) -> None:
        for joiner in self._joiners.values():
            self._joined_before.update(joiner.counts)
        self._handles, self._handle_of, self._joiners, self._active = {}, {}, {}, set()

    def _start_up(self) -> _Steps:
        """Send the commands that start ranging; return the problem, or an empty string."""
        # A board that is starting answers late: repeat the reset for as long as it takes.
        errors, tries = self.counts["error_answers"], 0
        self._ready = False
        while (yield _Command(messages.RESET, b"\0", tries=1, timeout_ns=RESET_NS)) is None:
            tries += 1
            if tries >= RESET_TRIES and (self._ready or self.counts["error_answers"] > errors):
                break
            self._ready = False
        yield _Command(None, tries=1, timeout_ns=READY_NS)
        self.rejected = {}
        self.state = "the board does not accept its settings"
        yield from self._set_window()
        for peer in self.settings.peers:
            problem = yield from self._open(peer)
            if problem:
                return problem
        self.starts += 1
        if self.settings.identify:
            answer = yield _Command(messages.DEVICE_INFO, tries=1)
            if answer is not None and answer.status == STATUS_OK:
                self.device_info = answer.payload[1:]
        return ""

    def _set_window(self) -> _Steps:
        """Request the window of the CIR. A board that refuses keeps its own: the CIR contains its size."""
        wanted = {_TAPS: self.settings.window, _LEAD: WINDOW_LEAD}
        self.window = None
        if not self.settings.window:
            return ""
        for count_bytes in (2, 1):
            for key, value in wanted.items():
                payload = messages.set_calibration(key, value, count_bytes)
                yield _Command(messages.SET_CALIBRATION, payload, tries=1)
            values = {}
            answer = yield _Command(messages.GET_CALIBRATION, messages.get_calibration(list(wanted)), tries=2)
            if answer is not None:
                values = messages.calibration_values(answer.payload)
                if _TAPS in values:
                    self.window = values[_TAPS], values.get(_LEAD, WINDOW_LEAD)
            if values == wanted or answer is None:
                break
        return ""

    def _open(self, peer: int) -> _Steps:
        number = struct.pack("<I", self.settings.session_id(peer))
        answer = yield _Command(messages.SESSION_INIT, number + b"\0")
        if answer is not None and answer.status != STATUS_OK:
            # The session may exist from before, on a board that has refused the reset.
            yield _Command(messages.SESSION_DEINIT, number, tries=1)
            answer = yield _Command(messages.SESSION_INIT, number + b"\0")
        if answer is None or answer.status != STATUS_OK:
            return _refused("SESSION_INIT", answer)
        # FiRa 1.3 firmware answers without a handle: it uses the session's number.
        (handle,) = struct.unpack("<I", answer.payload[1:5] if len(answer.payload) >= 5 else number)
        problem = yield from self._configure(handle, self._app_config(peer))
        if problem:
            return problem
        interval_ns = self.settings.effective_interval_ms * _MS
        # The first range may arrive before the answer to the start.
        self._handles[handle], self._joiners[handle] = peer, DiagnosticsMatcher(interval_ns)
        # Notifications may contain the handle, or the number of the session.
        self._handle_of |= {self.settings.session_id(peer): handle, handle: handle}
        answer = yield _Command(messages.RANGE_START, struct.pack("<I", handle))
        # The answer may be lost, and a repeated start is refused.
        started = handle in self._active or (answer is not None and answer.status == STATUS_OK)
        return "" if started else _refused("RANGE_START", answer)

    def _configure(self, handle: int, entries: list[tuple[int, bytes]]) -> _Steps:
        """Set the parameters of a session without those that the board rejects: firmware versions differ."""
        waiting, repeats = [entries], 1
        while waiting:
            packet = waiting.pop(0)
            answer = yield _Command(messages.SET_APP_CONFIG, messages.app_config(handle, packet))
            if answer is None:
                return _refused("SET_APP_CONFIG", answer)
            named = messages.rejected_tags(answer.payload)
            rejected = {tag: named[tag] for tag, _ in packet if tag in named}
            failed = answer.status != STATUS_OK
            if failed and not rejected and repeats:
                repeats -= 1
                waiting.insert(0, packet)
                continue
            if failed and not rejected and len(packet) == 1:
                rejected = {packet[0][0]: answer.status}
            if _NEEDED & rejected.keys():
                return _refused("SET_APP_CONFIG", answer, rejected)
            self.rejected |= rejected
            left = [entry for entry in packet if entry[0] not in rejected]
            if failed and left:
                # An answer that names no parameter: set each one with its own command.
                waiting = [left] if rejected else [[entry] for entry in left]
        return ""

    def _app_config(self, peer: int) -> list[tuple[int, bytes]]:
        """Return the parameters of a session, {tag, value}: those that worked on a real board, in their order."""
        s, is_tag = self.settings, self.settings.role is Role.TAG
        one, zero = b"\1", b"\0"
        entries = [
            (0x00, one if is_tag else zero),  # device type: controller, controlee
            (0x11, one if is_tag else zero),  # device role: initiator, responder
            (0x03, zero),  # unicast
            (0x01, b"\2"),  # DS-TWR, deferred
            (0x06, struct.pack("<H", s.address)),
            (0x04, bytes([s.channel])),
            (0x22, one),  # time-scheduled
            (0x02, zero),  # static STS
            (0x12, b"\3"),  # SP3
            (0x2E, b"\x0b"),  # result report
            (0x27, b"\x08\x07"),  # vendor id
            (0x28, b"\1\2\3\4\5\6"),  # static STS IV
            (0x0D, one),  # AoA request
            (0x2B, bytes(8)),  # initiation time
            (0x14, bytes([s.preamble_code or 10])),
            (0x15, b"\2"),  # SFD
            (0x08, struct.pack("<H", _SLOT_RSTU)),
            (0x09, struct.pack("<I", s.effective_interval_ms)),
            (0x1B, bytes([_ROUND_SLOTS])),
            (0x32, bytes(2)),  # no limit of measurements
            (0x2C, zero),  # no hopping
            (0x13, zero),  # RSSI: part of the diagnostics
            (0x2D, zero),  # block stride
            (0x05, one),  # controlees
            (0x07, struct.pack("<H", peer)),
            (0x24, zero),  # key rotation rate
            (0x35, one),  # STS length
        ]
        return [
            *entries,
            (_ENABLE_DIAGNOSTICS, one),
            (_DIAGNOSTICS_MASK, bytes([_CIR_METRICS_EMITTER_OFFSET])),
        ]

    def _advance(self, answer: Message | None, now_ns: int) -> None:
        """Go on with the start-up after an answer or a timeout."""
        assert self._steps is not None
        try:
            self._pending = self._steps.send(answer)
        except StopIteration as end:
            self._steps = self._pending = None
            self.state = str(end.value)
            self._received_ns = self._ended_ns = now_ns
            return
        self._pending.left = self._pending.tries
        self._send_pending(now_ns)

    def _send_pending(self, now_ns: int) -> None:
        command = self._pending
        assert command is not None
        command.left -= 1
        command.due_ns = now_ns + command.timeout_ns
        if command.name is not None:
            if len(self._outgoing) > MAX_OUTGOING_BYTES:
                # The port accepts no bytes.
                self._outgoing.clear()
            self._outgoing += encode(*command.name, command.payload)
        elif self._ready:
            self._advance(None, now_ns)

    def _check_times(self, now_ns: int) -> None:
        if self._boot_due:
            self._boot_due = False
            self.counts["restarts"] += 1
            self._begin(now_ns)
        elif self._pending is not None:
            if now_ns >= self._pending.due_ns:
                if self._pending.left > 0 and self._pending.name is not None:
                    self._send_pending(now_ns)
                else:
                    self._advance(None, now_ns)
        elif self._steps is None and self.state != "not connected":
            silence = now_ns - self._received_ns
            limit = SILENCE_NS + 5 * self.settings.effective_interval_ms * _MS
            if silence > 2 * limit or (self.state and now_ns - self._ended_ns > RETRY_NS):
                self._boot_due = True
            elif silence > limit and not self._asked:
                # An anchor without its tag may have nothing to report: ask whether the board works.
                self._asked = True
                for handle in self._handles:
                    self._outgoing += encode(*messages.GET_SESSION_STATE, struct.pack("<I", handle))

    def _handle(self, message: Message, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        name = (message.group, message.opcode)
        if self._steps is None:
            self._received_ns = now_ns
            self._asked = False
        if message.kind is MessageType.RESPONSE:
            if name == messages.GET_SESSION_STATE and self._steps is None:
                if message.status == STATUS_OK:
                    self._boot_due = message.payload[1:2] != bytes([SessionState.ACTIVE])
                else:
                    # The firmware has no such command, or no such session any more.
                    self._boot_due = self._has_ranged
            self._answer(name, message, now_ns)
        elif name == messages.GENERIC_ERROR:
            if self._pending is not None and self._pending.name is not None:
                self._answer(self._pending.name, message, now_ns)
        elif name == messages.DEVICE_STATUS:
            self._ready = message.status == DEVICE_READY
            if self._ready and self._pending is not None and self._pending.name is None:
                self._advance(None, now_ns)
        elif name == messages.BOOT:
            # The board has restarted by itself and has lost its sessions.
            self._boot_due = self._steps is None
        elif name == messages.SESSION_STATUS:
            self._follow(message)
        elif isinstance(message.content, RangeNotification):
            return self._ranges(message.content, now_ns, stamp_ns)
        elif isinstance(message.content, Diagnostics):
            return self._diagnostics(message.content, now_ns)
        return []

    def _answer(self, name: tuple[int, int], message: Message, now_ns: int) -> None:
        if message.status != STATUS_OK:
            self.counts["error_answers"] += 1
        if self._pending is not None and self._pending.name == name:
            if name == messages.RESET and message.status != STATUS_OK:
                return  # The reset is repeated after its timeout.
            self._advance(message, now_ns)

    def _follow(self, message: Message) -> None:
        """Restart the board if a session that was active has ended."""
        if len(message.payload) < 5:
            return
        number, state = struct.unpack_from("<IB", message.payload)
        handle = self._handle_of.get(number)
        if handle is None:
            return
        if state == SessionState.ACTIVE:
            self._active.add(handle)
        elif handle in self._active and self._steps is None:
            self._boot_due = True

    def _ranges(self, content: RangeNotification, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        found: list[RangeMeasurement] = []
        handle = self._handle_of.get(content.handle)
        for record in content.records:
            if handle is None or record.peer != self._handles[handle]:
                self.counts["unknown_session"] += 1
                continue
            self._has_ranged = True
            if record.status != STATUS_OK:
                name = RANGE_STATUSES.get(record.status, f"status 0x{record.status:02x}")
                self.counts[name.replace(" ", "_")] += 1
            joiner, arrival = self._joiners[handle], RangeArrival(record, stamp_ns)
            complete = joiner.add_range(content.sequence, arrival, self._decoder.damages, now_ns)
            found += self._measurements(handle, complete)
        return found

    def _diagnostics(self, content: Diagnostics, now_ns: int) -> list[RangeMeasurement]:
        handle = self._handle_of.get(content.handle)
        emitters = {frame.emitter for frame in content.frames if frame.received}
        if handle is None or emitters & (set(self.settings.peers) - {self._handles[handle]}):
            self.counts["unknown_session"] += 1
            return []
        complete = self._joiners[handle].add_diagnostics(content, self._decoder.damages, now_ns)
        return self._measurements(handle, complete)

    def _measurements(self, handle: int, complete: list[MatchedRange]) -> list[RangeMeasurement]:
        """Return the measurements of successful exchanges."""
        s, peer = self.settings, self._handles[handle]
        tag, anchor = (s.address, peer) if s.role is Role.TAG else (peer, s.address)
        found = []
        for joined in complete:
            record = joined.arrival.record
            if record.status != STATUS_OK or not record.range_m >= 0:
                continue
            reading = read_cir(joined.diagnostics, s.channel, record.rssi_dbm)
            if not math.isnan(reading.clock_offset_ppm):
                self.clock_offsets_ppm.append(reading.clock_offset_ppm)
            self.counts["ranges"] += 1
            self.counts["without_cir"] += not len(reading.cir)
            self.counts["inconsistent_cir"] += not reading.consistent
            found.append(
                RangeMeasurement(
                    joined.arrival.stamp_ns, tag, anchor, joined.sequence, 0, record.range_m, reading.cir
                )
            )
        return found


def _refused(command: str, answer: Message | None, rejected: Mapping[int, int] = {}) -> str:
    if answer is None:
        return f"the board does not answer {command}"
    tags = "".join(f", parameter 0x{tag:02x}: 0x{status:02x}" for tag, status in rejected.items())
    return f"the board refuses {command} with status 0x{answer.status:02x}{tags}"
