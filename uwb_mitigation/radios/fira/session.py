"""The host's state of a UCI board: start-up, ranging sessions, measurements. No I/O.

A `UciSession` takes received bytes and the time, and returns measurements and bytes to send. One ranging session is
opened for each peer: FiRa double-sided two-way ranging (deferred), SP3 frames, unicast.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.radios.fira import codes, messages
from uwb_mitigation.radios.fira.cir import PositionUnit, read_cir
from uwb_mitigation.radios.fira.codes import DEVICE_READY, STATUS_OK, PacketType, SessionState
from uwb_mitigation.radios.fira.joining import MIN_TIMEOUT_NS, DiagnosticsMatcher, RangeArrival
from uwb_mitigation.radios.fira.messages import Diagnostics, RangeNotification
from uwb_mitigation.radios.fira.packets import Packet, PacketDecoder, encode_packets
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
MIN_PAUSE_NS, MAX_PAUSE_NS = 500 * _MS, 30_000 * _MS
"""Pause before a board or session is started again; it doubles until the board has ranged for `STABLE_NS`."""

STABLE_NS = 30_000 * _MS
STOP_NS = 100 * _MS
"""Timeout of a command at the end."""

LATEST_NOTIFICATIONS = 16
"""Number of notifications among which repetitions are detected."""

SILENCE_NS = 1500 * _MS
"""Time without a notification, in addition to five intervals, after which the host asks whether the board works."""

MAX_OUTGOING_BYTES = 1 << 14
_NO_ANSWER = "no answer to the reset: is this a board with UCI firmware?"

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
    remaining: int = 0
    due_ns: int = 0


_Steps = Generator[_Command, Packet | None, str]


class UciSession:
    """The host's side of one board.

    Call `receive` after each read, and at least every 50 ms; send `outgoing`. `now_ns` is monotonic, `stamp_ns` is
    the clock of the stamps. Calibration keys may be in flash memory: a key is read first, written only if it differs,
    and restored by `stop`.

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
        position_unit: unit of the first-path positions.
        stopped: the commands of `stop` were answered.
    """

    def __init__(self, settings: UciSettings) -> None:
        settings.check()
        self.settings = settings
        self.state = "not connected"
        self.window: tuple[int, int] | None = None
        self.rejected: dict[int, int] = {}
        self.device_info = b""
        self.starts = 0
        names = "ranges without_cir inconsistent_cir unknown_session duplicates restarts error_answers calibration_writes"
        self.counts: Counter[str] = Counter(dict.fromkeys(names.split(), 0))
        self.clock_offsets_ppm: deque[float] = deque(maxlen=200)
        self.position_unit = PositionUnit()
        self.stopped = False
        self._decoder = PacketDecoder()
        self._earlier_counts: Counter[str] = Counter(DiagnosticsMatcher(0).counts)
        self._outgoing = bytearray()
        self._steps: _Steps | None = None
        self._pending: _Command | None = None
        self._peers: dict[int, int] = {}
        self._handles: dict[int, int] = {}
        self._matchers: dict[int, DiagnosticsMatcher] = {}
        self._arrivals: deque[RangeArrival] = deque()
        self._notifications: deque[bytes] = deque(maxlen=LATEST_NOTIFICATIONS)
        self._failures: Counter[str] = Counter()
        self._active: set[int] = set()
        self._ended: dict[int, str] = {}
        self._calibration = _Calibration()
        self._ready = False
        self._restart_ns: int | None = None
        self._pause_ns = MIN_PAUSE_NS
        self._has_ranged = self._stopping = self._state_requested = False
        self._received_ns = self._started_ns = 0

    def opened(self, now_ns: int) -> None:
        """Start the board after its port was opened."""
        self._decoder.reset()
        self._outgoing.clear()
        self._begin(now_ns)

    def closed(self) -> None:
        """Stop after the port was lost."""
        self._steps = self._pending = self._restart_ns = None
        self._outgoing.clear()
        self._end_sessions()
        self.state = "not connected"

    def stop(self, now_ns: int) -> None:
        """End all sessions and restore the calibration, before the port is closed; `stopped` follows."""
        self._stopping, self._restart_ns = True, None
        self._steps = self._shut_down()
        self._advance(None, now_ns)

    @property
    def is_waiting(self) -> bool:
        """Whether the session pauses before it starts the board again."""
        return self._restart_ns is not None

    def outgoing(self) -> bytes:
        """Return the bytes to send, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def take_failures(self) -> Counter[str]:
        """Return the numbers of failed exchanges since the last call, {cause: count}."""
        failures, self._failures = self._failures, Counter()
        return failures

    def totals(self) -> dict[str, int]:
        """Return all counts for diagnostics, {name: count}."""
        matched = Counter(self._earlier_counts)
        for matcher in self._matchers.values():
            matched.update(matcher.counts)
        return {**self.counts, **matched, **self._decoder.counts}

    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        """Handle received bytes and timeouts; return new measurements in the order of their arrival."""
        for packet in self._decoder.feed(data, now_ns):
            self._handle(packet, now_ns, stamp_ns)
        for matcher in self._matchers.values():
            matcher.expire(now_ns)
        measurements = self._complete_measurements(now_ns)
        self._check_times(now_ns)
        return measurements

    def _begin(self, now_ns: int) -> None:
        """Start the board with a reset."""
        reason = self.state if self.is_waiting else ""
        self._end_sessions()
        self.state = reason or _NO_ANSWER
        self._steps = self._start_up()
        self._received_ns = now_ns
        self._restart_ns = None
        self._state_requested = self._has_ranged = self.stopped = self._stopping = False
        self._advance(None, now_ns)

    def _schedule(self, reason: str, now_ns: int) -> None:
        """Start the board, or the sessions that have ended, again after a pause."""
        if self.is_waiting or self._stopping:
            return
        if self._started_ns and not self.state and now_ns - self._started_ns > STABLE_NS:
            self._pause_ns = MIN_PAUSE_NS
        self.state = f"{reason}; it is started again after {self._pause_ns / 1e9:g} s"
        self._restart_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, MAX_PAUSE_NS)

    def _end_sessions(self) -> None:
        for matcher in self._matchers.values():
            self._earlier_counts.update(matcher.counts)
        for arrival in self._arrivals:
            arrival.is_complete = True
        self._handles, self._matchers, self._active, self._ended = {}, {}, set(), {}

    def _start_up(self) -> _Steps:
        """Send the commands that start ranging; return the problem, or an empty string."""
        # A board that is starting answers late: repeat the reset for as long as it takes.
        errors, tries = self.counts["error_answers"], 0
        self._ready = False
        while (yield _Command(codes.RESET, b"\0", tries=1, timeout_ns=RESET_NS)) is None:
            tries += 1
            if tries >= RESET_TRIES and (self._ready or self.counts["error_answers"] > errors):
                break
            if tries >= RESET_TRIES:
                self.state = _NO_ANSWER
            self._ready = False
        yield _Command(None, tries=1, timeout_ns=READY_NS)
        if self.state == _NO_ANSWER:
            self.state = "the board has not confirmed its settings"
        self.rejected = {}
        if self.settings.window:
            self.window = yield from self._calibration.set_window(self.settings.window, self.counts)
        for peer in self.settings.peers:
            problem = yield from self._open(peer)
            if problem:
                return problem
        self.starts += 1
        if self.settings.identify:
            answer = yield _Command(codes.DEVICE_INFO, tries=1)
            if answer is not None and answer.status == STATUS_OK:
                self.device_info = answer.payload[1:]
        return ""

    def _open_again(self, handles: list[int]) -> _Steps:
        """Open sessions again that have ended, without a reset of the board and its other sessions."""
        for handle in handles:
            peer = self._peers[handle]
            yield _Command(codes.SESSION_DEINIT, struct.pack("<I", handle), tries=1)
            del self._ended[handle]
            self._earlier_counts.update(self._matchers.pop(handle).counts)
            problem = yield from self._open(peer)
            if problem:
                return problem
        self.starts += 1
        return ""

    def _shut_down(self) -> _Steps:
        for handle in list(self._matchers):
            for name in (codes.RANGE_STOP, codes.SESSION_DEINIT):
                yield _Command(name, struct.pack("<I", handle), tries=1, timeout_ns=STOP_NS)
        yield from self._calibration.restore(self.counts)
        return "not connected"

    def _open(self, peer: int) -> _Steps:
        number = struct.pack("<I", self.settings.session_id(peer))
        answer = yield _Command(codes.SESSION_INIT, number + b"\0")
        if answer is not None and answer.status != STATUS_OK:
            # The session may exist from before, on a board that has refused the reset.
            yield _Command(codes.SESSION_DEINIT, number, tries=1)
            answer = yield _Command(codes.SESSION_INIT, number + b"\0")
        if answer is None or answer.status != STATUS_OK:
            return _refused("SESSION_INIT", answer)
        # FiRa 1.3 firmware answers without a handle: it uses the session's number.
        (handle,) = struct.unpack("<I", answer.payload[1:5] if len(answer.payload) >= 5 else number)
        problem = yield from self._configure(handle, self._app_config(peer))
        if problem:
            return problem
        interval_ns = self.settings.effective_interval_ms * _MS
        # The first range may arrive before the answer to the start.
        self._peers[handle], self._matchers[handle] = peer, DiagnosticsMatcher(interval_ns)
        self._notifications.clear()
        # Notifications may contain the handle, or the number of the session.
        self._handles |= {self.settings.session_id(peer): handle, handle: handle}
        answer = yield _Command(codes.RANGE_START, struct.pack("<I", handle))
        # The answer may be lost, and a repeated start is refused.
        if handle in self._ended or handle in self._active:
            return ""
        if answer is None or answer.status != STATUS_OK:
            return _refused("RANGE_START", answer)
        # The notification of the active state may be lost.
        self._active.add(handle)
        return ""

    def _configure(self, handle: int, entries: list[tuple[int, bytes]]) -> _Steps:
        """Set the parameters of a session without those that the board rejects: firmware versions differ."""
        waiting, repeats = [entries], 1
        while waiting:
            packet = waiting.pop(0)
            answer = yield _Command(codes.SET_APP_CONFIG, messages.app_config(handle, packet))
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
            accepted = [entry for entry in packet if entry[0] not in rejected]
            if failed and accepted:
                # An answer that names no parameter: set each one with its own command.
                waiting = [accepted] if rejected else [[entry] for entry in accepted]
        return ""

    def _app_config(self, peer: int) -> list[tuple[int, bytes]]:
        """Return the parameters of a session, {tag, value}: those that worked on a real board, in their order."""
        s, is_tag = self.settings, self.settings.role is Role.TAG
        on, off = b"\1", b"\0"
        entries = [
            (0x00, on if is_tag else off),  # device type: controller, controlee
            (0x11, on if is_tag else off),  # device role: initiator, responder
            (0x03, off),  # unicast
            (0x01, b"\2"),  # DS-TWR, deferred
            (0x06, struct.pack("<H", s.address)),
            (0x04, bytes([s.channel])),
            (0x22, on),  # time-scheduled
            (0x02, off),  # static STS
            (0x12, b"\3"),  # SP3
            (0x2E, b"\x0b"),  # result report
            (0x27, b"\x08\x07"),  # vendor id
            (0x28, b"\1\2\3\4\5\6"),  # static STS IV
            (0x0D, on),  # AoA request
            (0x2B, bytes(8)),  # initiation time
            (0x14, bytes([s.preamble_code or 10])),
            (0x15, b"\2"),  # SFD
            (0x08, struct.pack("<H", _SLOT_RSTU)),
            (0x09, struct.pack("<I", s.effective_interval_ms)),
            (0x1B, bytes([_ROUND_SLOTS])),
            (0x32, bytes(2)),  # no limit of measurements
            (0x2C, off),  # no hopping
            (0x13, off),  # RSSI: part of the diagnostics
            (0x2D, off),  # block stride
            (0x05, on),  # controlees
            (0x07, struct.pack("<H", peer)),
            (0x24, off),  # key rotation rate
            (0x35, on),  # STS length
        ]
        return [
            *entries,
            (_ENABLE_DIAGNOSTICS, on),
            (_DIAGNOSTICS_MASK, bytes([_CIR_METRICS_EMITTER_OFFSET])),
        ]

    def _advance(self, answer: Packet | None, now_ns: int) -> None:
        """Go on with the commands after an answer or a timeout."""
        assert self._steps is not None
        try:
            self._pending = self._steps.send(answer)
        except StopIteration as end:
            self._steps = self._pending = None
            self.state = str(end.value)
            self._received_ns = self._started_ns = now_ns
            self.stopped = self._stopping
            if self.state:
                self._started_ns = 0
                self._schedule(self.state, now_ns)
            return
        self._pending.remaining = self._pending.tries
        self._send_pending(now_ns)

    def _send_pending(self, now_ns: int) -> None:
        command = self._pending
        assert command is not None
        command.remaining -= 1
        command.due_ns = now_ns + command.timeout_ns
        if command.name is not None:
            if len(self._outgoing) > MAX_OUTGOING_BYTES:
                # The port accepts no bytes.
                self._outgoing.clear()
            self._outgoing += encode_packets(*command.name, command.payload)
        elif self._ready:
            self._advance(None, now_ns)

    def _check_times(self, now_ns: int) -> None:
        if self._pending is not None:
            if now_ns >= self._pending.due_ns:
                if self._pending.remaining > 0 and self._pending.name is not None:
                    self._send_pending(now_ns)
                else:
                    self._advance(None, now_ns)
        elif self._restart_ns is not None:
            if now_ns >= self._restart_ns:
                self._restart(now_ns)
        elif self._steps is None and self.state != "not connected":
            idle_ns = now_ns - self._received_ns
            limit_ns = SILENCE_NS + 5 * self.settings.effective_interval_ms * _MS
            if self._ended:
                self._schedule(next(iter(self._ended.values())), now_ns)
            elif idle_ns > 2 * limit_ns:
                self._schedule("the board sends no data", now_ns)
            elif idle_ns > limit_ns and not self._state_requested:
                # An anchor without its tag may have nothing to report: ask whether the board works.
                self._state_requested = True
                for handle in self._matchers:
                    self._outgoing += encode_packets(*codes.GET_SESSION_STATE, struct.pack("<I", handle))

    def _restart(self, now_ns: int) -> None:
        """Open the sessions that have ended, or start the board if it does not range at all."""
        self.counts["restarts"] += 1
        if self._ended and self._started_ns:
            self._restart_ns = None
            self._steps = self._open_again(sorted(self._ended))
            self._advance(None, now_ns)
        else:
            self._begin(now_ns)

    def _handle(self, packet: Packet, now_ns: int, stamp_ns: int) -> None:
        name = (packet.group, packet.opcode)
        if self._steps is None:
            self._received_ns = now_ns
            self._state_requested = False
        if packet.kind is PacketType.RESPONSE:
            if name == codes.GET_SESSION_STATE and self._steps is None:
                is_active = packet.payload[1:2] == bytes([SessionState.ACTIVE])
                # The firmware may have no such command, or no such session any more.
                if self._has_ranged if packet.status != STATUS_OK else not is_active:
                    self._started_ns = 0
                    self._schedule("the board has ended its sessions", now_ns)
            self._answer(name, packet, now_ns)
        elif name == codes.GENERIC_ERROR:
            if self._pending is not None and self._pending.name is not None:
                self._answer(self._pending.name, packet, now_ns)
        elif name == codes.DEVICE_STATUS:
            self._ready = packet.status == DEVICE_READY
            if self._ready and self._pending is not None and self._pending.name is None:
                self._advance(None, now_ns)
        elif name == codes.BOOT:
            if self._steps is None:
                # The board has lost its sessions.
                self._schedule("the board has restarted by itself", now_ns)
                self._started_ns = 0
        elif name == codes.SESSION_STATUS:
            self._follow(packet)
        elif packet.content is not None:
            if packet.payload in self._notifications:
                self.counts["duplicates"] += 1
                return
            self._notifications.append(packet.payload)
            if isinstance(packet.content, RangeNotification):
                self._add_ranges(packet.content, now_ns, stamp_ns)
            else:
                self._add_diagnostics(packet.content, now_ns)

    def _answer(self, name: tuple[int, int], packet: Packet, now_ns: int) -> None:
        if packet.status != STATUS_OK:
            self.counts["error_answers"] += 1
        if self._pending is not None and self._pending.name == name:
            if name == codes.RESET and packet.status != STATUS_OK:
                return  # The reset is repeated after its timeout.
            self._advance(packet, now_ns)

    def _follow(self, packet: Packet) -> None:
        """Note a session that was active and has ended."""
        if len(packet.payload) < 5:
            return
        number, state = struct.unpack_from("<IB", packet.payload)
        handle = self._handles.get(number)
        if handle is None or handle not in self._matchers:
            return
        if state == SessionState.ACTIVE:
            self._active.add(handle)
        elif handle in self._active and not self._stopping:
            self._active.discard(handle)
            reason = packet.payload[5] if len(packet.payload) > 5 else 0
            peer = f"session with {self._peers[handle]}"
            self._ended[handle] = f"the board has ended the {peer}: {codes.reason_text(reason)}"

    def _add_ranges(self, content: RangeNotification, now_ns: int, stamp_ns: int) -> None:
        handle = self._handles.get(content.handle)
        for record in content.records:
            if handle is None or handle not in self._matchers or record.peer != self._peers[handle]:
                self.counts["unknown_session"] += 1
                continue
            self._has_ranged = True
            arrival = RangeArrival(handle, content.sequence, record, now_ns, stamp_ns)
            if record.status == STATUS_OK and record.range_m >= 0:
                self._arrivals.append(arrival)
            else:
                cause = codes.exchange_cause(record.status) if record.status else "no distance"
                self.counts[cause.replace(" ", "_")] += 1
                self._failures[cause] += 1
            self._matchers[handle].add_range(arrival, self._decoder.damages, now_ns)

    def _add_diagnostics(self, content: Diagnostics, now_ns: int) -> None:
        handle = self._handles.get(content.handle)
        emitters = {frame.emitter for frame in content.frames if frame.received}
        if (
            handle is None
            or handle not in self._matchers
            or emitters & (set(self.settings.peers) - {self._peers[handle]})
        ):
            self.counts["unknown_session"] += 1
        else:
            self._matchers[handle].add_diagnostics(content, self._decoder.damages, now_ns)

    def _complete_measurements(self, now_ns: int) -> list[RangeMeasurement]:
        """Return the measurements that wait for nothing; later ones wait for earlier ones."""
        timeout_ns = 2 * max(2 * self.settings.effective_interval_ms * _MS, MIN_TIMEOUT_NS)
        measurements = []
        while self._arrivals:
            arrival = self._arrivals[0]
            if not arrival.is_complete and now_ns - arrival.arrived_ns <= timeout_ns:
                break
            measurements.append(self._measurement(self._arrivals.popleft()))
        return measurements

    def _measurement(self, arrival: RangeArrival) -> RangeMeasurement:
        s, peer, record = self.settings, self._peers[arrival.handle], arrival.record
        tag, anchor = (s.address, peer) if s.role is Role.TAG else (peer, s.address)
        report = read_cir(arrival.diagnostics, s.channel, record.rssi_dbm, self.position_unit)
        if not math.isnan(report.clock_offset_ppm):
            self.clock_offsets_ppm.append(report.clock_offset_ppm)
        self.counts["ranges"] += 1
        self.counts["without_cir"] += not len(report.cir)
        self.counts["inconsistent_cir"] += not report.consistent
        return RangeMeasurement(
            arrival.stamp_ns, tag, anchor, arrival.sequence, 0, record.range_m, report.cir
        )


class _Calibration:
    """The calibration keys of a board that determine the window of the CIR.

    They may be in flash memory: a key that could not be read is not written, one that already has the requested value
    is not written either, and a value that the board did not accept is not written again.
    """

    def __init__(self) -> None:
        self._original: dict[str, int] = {}
        self._written: set[tuple[str, int]] = set()
        self._results: dict[tuple[str, int], int | None] = {}
        self._count_sizes: tuple[int, ...] = (2, 1)

    def set_window(
        self, taps: int, counts: Counter[str]
    ) -> Generator[_Command, Packet | None, tuple[int, int] | None]:
        """Request a window; return the taps and the lead that the board has, None = unknown.

        A board that refuses keeps its own window: the CIR contains its size.
        """
        requested = {_TAPS: taps, _LEAD: WINDOW_LEAD}
        values = yield from self._read(requested)
        for size in self._count_sizes:
            different = {
                key: value
                for key, value in requested.items()
                if key in values and values[key] != value and self._results.get((key, value)) != values[key]
            }
            if not different:
                break
            for key in different:
                if (key, values[key]) not in self._written:
                    self._original[key] = values[key]
            before = values
            yield from self._write(different, size, counts)
            values = yield from self._read(requested)
            if any(values.get(key) != before[key] for key in different):
                self._count_sizes = (size,)
                break
        for key, value in requested.items():
            self._results[key, value] = values.get(key)
            if key in self._original:
                self._written.add((key, values.get(key, value)))
        return (values[_TAPS], values.get(_LEAD, WINDOW_LEAD)) if _TAPS in values else None

    def restore(self, counts: Counter[str]) -> Generator[_Command, Packet | None, None]:
        """Write the original values of the keys that were changed."""
        values = (yield from self._read(self._original)) if self._original else {}
        changed = {key: value for key, value in self._original.items() if values.get(key, value) != value}
        yield from self._write(changed, self._count_sizes[0], counts)

    def _read(self, keys: Iterable[str]) -> Generator[_Command, Packet | None, dict[str, int]]:
        answer = yield _Command(codes.GET_CALIBRATION, messages.get_calibration(list(keys)), tries=2)
        return messages.calibration_values(answer.payload) if answer is not None else {}

    def _write(
        self, values: Mapping[str, int], count_size: int, counts: Counter[str]
    ) -> Generator[_Command, Packet | None, None]:
        for key, value in values.items():
            counts["calibration_writes"] += 1
            yield _Command(codes.SET_CALIBRATION, messages.set_calibration(key, value, count_size), tries=1)


def _refused(command: str, answer: Packet | None, rejected: Mapping[int, int] = {}) -> str:
    if answer is None:
        return f"the board does not answer {command}"
    names = "".join(
        f"; {codes.parameter_name(tag)}: {codes.status_text(status)}" for tag, status in rejected.items()
    )
    return f"the board refuses {command}: {codes.status_text(answer.status)}{names}"
