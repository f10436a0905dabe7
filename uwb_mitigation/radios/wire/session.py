"""The host's state of the link to a board: handshake, mode, clock, losses. No I/O.

A `BoardSession` takes received bytes and the time, and returns events and bytes to send. The owner of the
port calls `receive` after each read, `tick` at least ten times a second, and sends `outgoing`.
"""

from __future__ import annotations

import enum
import logging
from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.capture import Session
from uwb_mitigation.radios.settings import PortMessage, RadioSettings, RadioStatus
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.clock import DeviceClock
from uwb_mitigation.radios.wire.framing import FrameDecoder, FrameEncoder, WireFrame
from uwb_mitigation.radios.wire.layout import PROTOCOL_VERSION, Flag, MessageType, Mode
from uwb_mitigation.radios.wire.messages import Correction, Hello, RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets

_MS = 10**6
REQUEST_INTERVAL_NS = 500 * _MS
"""Interval between retries of an unanswered request."""

SYNC_INTERVAL_NS = 1000 * _MS
"""Mean interval between time synchronisations. It is varied to avoid beats with the board's own period."""

FIRST_SYNC_INTERVAL_NS = 47 * _MS
FIRST_SYNCS = 8
"""Number of round trips in quick succession after a HELLO, for a first clock estimate."""

LINK_TIMEOUT_NS = 3000 * _MS
"""Timeout of the link. A board sends at least one frame per second."""

MAX_GAP = 1 << 20
"""Largest plausible gap in sequence numbers. A larger gap means that the board was restarted."""

MAX_TRIES = 6
"""Number of requests for radio settings or offsets after which an unanswered request counts as unsupported."""

_MAX_CONSECUTIVE_STALE = 3
_MAX_PENDING = 1024
_GOLDEN_RATIO = 0.618
_MAX_OUTGOING_BYTES = 1 << 16
_SEQUENCES = 1 << 32
_STAMPED = (MessageType.RANGE_CIR, MessageType.RANGE_CORRECTED)

_COUNTS = (
    "lost stale withheld unknown_type malformed wrong_model wrong_offsets unsolicited unsent connections"
)
"""Counts of a session: `lost` frames (missing sequence numbers); intact frames that were not delivered, because they are `stale`
(sequence number not above that of a frame already received), were `withheld` (received while not connected), are of an
`unknown_type`, are `malformed` (of a known type, but with invalid contents), are corrections by the `wrong_model` or with the
`wrong_offsets` (before the board confirmed the requested ones), or are `unsolicited` answers; requests that were `unsent`,
because the output queue was full; and `connections`, the HELLOs that started one."""

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

RADIO_PROBLEM = "the radio's settings are not used"
OFFSETS_PROBLEM = "the offsets are not set, so the corrections of the board are not published"


class LinkState(enum.Enum):
    """State of the session."""

    CONNECTING = "waiting for the board's HELLO"
    READY = "connected"
    WRONG_VERSION = "the board uses another protocol version"


class Loss(enum.Enum):
    """Event: why a connection ended. No data is delivered until the next `Hello`."""

    TIMEOUT = "no intact frame was received for 3 s"
    RESET = "the board restarted"
    OUT_OF_SEQUENCE = "the sequence numbers of the board are out of order"
    CLOSED = "the port was closed"


@dataclass(frozen=True, slots=True)
class Refused:
    """The board does not use the requested settings or offsets; without the offsets, its corrections are not delivered.

    Attributes:
        problem: `RADIO_PROBLEM` or `OFFSETS_PROBLEM`.
        text: the reason.
    """

    problem: str
    text: str


Event = object
"""A `Hello` when a connection begins, a `Loss` when it ends, `Refused`, a `RangeMeasurement`, another message of the board, or a
`PortMessage`."""


class _Request:
    """A request that is repeated until the board answers it.

    Args:
        unanswered: the problem if the board answers none of `MAX_TRIES` requests; empty = repeat forever.
    """

    def __init__(self, unanswered: str = "") -> None:
        self.unanswered = unanswered
        self.message: messages.Message | None = None
        self.pending = False
        self.tries = 0
        self.sent: dict[int, None] = {}

    def begin(self, message: messages.Message) -> None:
        """Start a new request; answers to earlier requests are ignored."""
        self.repeat(message)
        self.sent.clear()

    def repeat(self, message: messages.Message | None) -> None:
        """Request `message` from now on; None = no request."""
        self.message, self.pending, self.tries = message, message is not None, 0

    def is_answered_by(self, sequence: int) -> bool:
        """Whether the frame `sequence` was one of the requests; then the request is done."""
        if sequence not in self.sent:
            return False
        self.sent.clear()
        self.pending = False
        return True


class BoardSession(Session):
    """The host's side of the protocol with one board.

    There are two clocks: `now_ns` is monotonic and measures intervals; `stamp_ns` is the node's clock, used
    for the stamps of measurements. Read both clocks immediately after the bytes.

    Args:
        mode: mode to request; None = do not change the board's mode.
        expected_model_id: identity of the expected model on the board; corrections by other models are
            counted and not delivered. None accepts any.

    Attributes:
        state: state of the session.
        hello: last HELLO of the board; None while not connected.
        radio: last RADIO of the board; None while not connected or if the board has sent none.
        foreign_version: with WRONG_VERSION, the protocol version of the board.
        counts: numbers of frames; `totals` also contains those of damaged bytes.
        clock: estimate of the board's clock relative to the node's.
    """

    def __init__(self, *, mode: Mode | None = None, expected_model_id: int | None = None) -> None:
        super().__init__()
        self.state = LinkState.CONNECTING
        self.hello: Hello | None = None
        self.radio: RadioConfigured | None = None
        self.foreign_version: int | None = None
        self.counts = Counter(dict.fromkeys(_COUNTS.split(), 0))
        self.clock = DeviceClock()
        self._decoder = FrameDecoder()
        self._encoder = FrameEncoder()
        self._expected_model_id = expected_model_id
        self._mode = mode
        self._mode_request = _Request()
        unsupported = "its firmware does not support {}: flash a newer version, or {}"
        self._radio_request = _Request(unsupported.format("radio settings", "do not set any"))
        self._offsets_request = _Request(unsupported.format("offsets", "correct on the host"))
        self._offsets_confirmed = False
        self._boot_key: tuple[int, int] | None = None
        self._next_request_ns = 0
        self._next_sync_ns = 0
        self._num_syncs = 0
        self._sync_send_times_ns: dict[int, int] = {}
        self._next_sequence = 0
        self._consecutive_stale = 0
        self._foreign_frames = 0
        self._last_received_ns = 0

    def totals(self) -> dict[str, int]:
        """Return the counts of frames for diagnostics, {name: count}."""
        decoder = self._decoder
        intact = {name: decoder.counts[name] for name in ("frames", "foreign_version")}
        return intact | {"corrupt": decoder.corrupt} | self.counts

    @property
    def model_matches(self) -> bool:
        """False if the connected board has another model than the expected one."""
        return self.hello is None or self._expected_model_id in (None, self.hello.model_id)

    def closed(self, now_ns: int) -> list[Event]:
        """Begin again after the port was opened, lost or closed: discard partly received and unsent bytes."""
        self._decoder.reset()
        self._outgoing.clear()
        self._last_received_ns = now_ns
        return self._disconnect(Loss.CLOSED, now_ns)

    opened = closed

    def idle_ns(self, now_ns: int) -> int:
        """Time since the last intact frame was received."""
        return now_ns - self._last_received_ns

    def set_mode(self, mode: Mode) -> None:
        """Request `mode` until the board answers; a `PortMessage` follows."""
        self._mode = mode
        self._mode_request.begin(mode)
        self._next_request_ns = 0

    def set_radio(self, settings: RadioSettings) -> None:
        """Request `settings` now and after each start of the board; a `RadioConfigured` or `Refused` follows.

        Raises:
            ParameterError: no radio has such settings.
        """
        settings.check()
        self._radio_request.begin(settings)
        self._next_request_ns = 0

    def set_offsets(self, offsets: Offsets) -> None:
        """Request, now and after each start of the board, that it subtracts these offsets from its ranges.

        Until the board confirms them, its corrections are counted and not delivered. `Refused` follows if it
        cannot use them, except for offsets of 0, which a board without offsets has anyway.
        """
        self._offsets_confirmed = False
        self._offsets_request.begin(offsets)
        self._next_request_ns = 0

    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Event]:
        """Return the events in the received bytes, in order. Never raises; invalid bytes are counted."""
        observed: list[Event] = []
        frames = self._decoder.feed(data)
        if frames:
            self._last_received_ns = now_ns
        for frame in frames:
            observed += self._handle(frame, now_ns, stamp_ns)
        observed += self._check_foreign_versions(now_ns)
        return observed + self.tick(now_ns, stamp_ns)

    def tick(self, now_ns: int, stamp_ns: int) -> list[Event]:
        """Repeat requests, synchronise the clock, and check for a timeout."""
        observed: list[Event] = []
        if self.state is LinkState.READY and self.idle_ns(now_ns) > LINK_TIMEOUT_NS:
            observed += self._disconnect(Loss.TIMEOUT, now_ns)
        if now_ns >= self._next_request_ns:
            self._next_request_ns = now_ns + REQUEST_INTERVAL_NS
            if self.state is not LinkState.READY:
                self._send(MessageType.GET_INFO, b"")
                return observed
            if self._send_request(self._offsets_request) and self._offsets:
                observed.append(Refused(OFFSETS_PROBLEM, self._offsets_request.unanswered))
            if self._mode_request.pending:
                self._send_request(self._mode_request)
            elif self._send_request(self._radio_request):
                observed.append(Refused(RADIO_PROBLEM, self._radio_request.unanswered))
        if self.state is LinkState.READY and now_ns >= self._next_sync_ns:
            self._send_sync(now_ns, stamp_ns)
        return observed

    def _handle(self, frame: WireFrame, now_ns: int, stamp_ns: int) -> list[Event]:
        try:
            return self._parse(frame, now_ns, stamp_ns)
        except LinkError:
            self.counts["malformed"] += 1
            return []

    def _parse(self, frame: WireFrame, now_ns: int, stamp_ns: int) -> list[Event]:
        if frame.type == MessageType.HELLO:
            return self._handle_hello(frame, now_ns, stamp_ns)
        if self.state is not LinkState.READY:
            self.counts["withheld"] += 1
            return []
        if not self._in_sequence(frame):
            if self._consecutive_stale >= _MAX_CONSECUTIVE_STALE:
                return self._disconnect(Loss.OUT_OF_SEQUENCE, now_ns)
            return []
        at_ns = 0
        if frame.type in _STAMPED and not frame.flags & Flag.ANSWER:
            at_ns = self.clock.stamp(frame.time_us, stamp_ns)
        message = messages.decode(frame.type, frame.payload, stamp_ns=at_ns)
        if isinstance(message, Correction):
            return self._handle_correction(message, bool(frame.flags & Flag.ANSWER))
        if isinstance(message, messages.TimeSyncReply):
            self._handle_sync(message, frame.time_us, stamp_ns)
            return []
        if isinstance(message, RadioConfigured):
            return self._handle_radio(message, bool(frame.flags & Flag.ANSWER))
        if isinstance(message, messages.OffsetsAnswer):
            return self._handle_offsets(message)
        if isinstance(message, RadioStatus) and self.radio is None:
            self._send(MessageType.GET_RADIO, b"")
        if isinstance(message, RangeMeasurement | messages.Log | messages.BoardStatus | RadioStatus):
            return [message]
        # A board never sends the types of the host: count them as unknown.
        self.counts["unknown_type"] += 1
        return []

    def _handle_hello(self, frame: WireFrame, now_ns: int, stamp_ns: int) -> list[Event]:
        hello = messages.decode(frame.type, frame.payload)
        assert isinstance(hello, Hello)
        boot = (hello.board_id, hello.boot_id)
        observed: list[Event] = []
        if self.state is LinkState.READY:
            if boot != self._boot_key:
                observed += self._disconnect(Loss.RESET, now_ns)
            elif not self._in_sequence(frame):
                return []
        if boot != self._boot_key:
            self.clock.reset()
            self._boot_key = boot
        self.clock.arrival(frame.time_us, stamp_ns)
        self.hello = hello
        if self.state is not LinkState.READY:
            self.state = LinkState.READY
            self.counts["connections"] += 1
            self.foreign_version = None
            self._next_sequence = (frame.sequence + 1) % _SEQUENCES
            self._consecutive_stale = 0
            self._num_syncs = 0
            self._next_sync_ns = now_ns
            self._mode_request.repeat(None if self._mode == hello.mode else self._mode)
            self._radio_request.repeat(self._radio_request.message)
            self._offsets_request.repeat(self._offsets_request.message)
            self._offsets_confirmed = False
            self._next_request_ns = now_ns
            observed.append(hello)
        elif frame.flags & Flag.ANSWER and self._mode_request.is_answered_by(hello.request_sequence):
            requested = hello.mode if self._mode is None else self._mode
            text = f"the board is in mode {requested.name}"
            if hello.mode != requested:
                text = f"the board stays in mode {hello.mode.name} instead of {requested.name}: does it have a model?"
            observed.append(PortMessage(logging.INFO if hello.mode == requested else logging.WARNING, text))
        return observed

    @property
    def _offsets(self) -> Offsets:
        message = self._offsets_request.message
        return message if isinstance(message, Offsets) else NO_OFFSETS

    def _send_request(self, request: _Request) -> bool:
        """Send a pending request; return True if it was given up after too many unanswered tries."""
        if not request.pending or request.message is None:
            return False
        request.tries += 1
        if request.unanswered and request.tries > MAX_TRIES:
            request.pending = False
            return True
        sequence = self._send(*messages.encode(request.message))
        if sequence is not None:
            _add_bounded(request.sent, sequence, None)
        return False

    def _handle_offsets(self, answer: messages.OffsetsAnswer) -> list[Event]:
        if not self._offsets_request.is_answered_by(answer.request_sequence):
            self.counts["unsolicited"] += 1
            return []
        self._offsets_confirmed = answer.accepted
        text = f"it can store {answer.slots} offsets, but {len(self._offsets)} were requested"
        return [] if answer.accepted else [Refused(OFFSETS_PROBLEM, text)]

    def _handle_radio(self, radio: RadioConfigured, answer: bool) -> list[Event]:
        if answer and self._radio_request.is_answered_by(radio.request_sequence) and not radio.accepted:
            return [Refused(RADIO_PROBLEM, radio.text)]
        self.radio = radio
        return [radio]

    def _handle_correction(self, correction: Correction, answer: bool) -> list[Event]:
        # This host never requests corrections from a board.
        problem = "unsolicited" if answer else ""
        if not self.model_matches:
            problem = "wrong_model"
        elif self._offsets and not self._offsets_confirmed:
            problem = "wrong_offsets"
        if problem:
            self.counts[problem] += 1
        return [] if problem else [correction]

    def _handle_sync(self, reply: messages.TimeSyncReply, replied_us: int, stamp_ns: int) -> None:
        sent_ns = self._sync_send_times_ns.pop(reply.request_sequence, None)
        if sent_ns is None:
            self.counts["unsolicited"] += 1
        else:
            self.clock.exchange(sent_ns, reply.received_us, replied_us, stamp_ns)

    def _in_sequence(self, frame: WireFrame) -> bool:
        gap = (frame.sequence - self._next_sequence) % _SEQUENCES
        if gap > MAX_GAP:
            self.counts["stale"] += 1
            self._consecutive_stale += 1
            return False
        self.counts["lost"] += gap
        self._next_sequence = (frame.sequence + 1) % _SEQUENCES
        self._consecutive_stale = 0
        return True

    def _check_foreign_versions(self, now_ns: int) -> list[Event]:
        count, version = self._decoder.counts["foreign_version"], self._decoder.last_foreign_version
        if count == self._foreign_frames:
            return []
        self._foreign_frames = count
        # The buffers may still contain frames of firmware that ran before the connected board was restarted.
        if self.state is LinkState.READY or version is None:
            return []
        self._last_received_ns = now_ns
        if self.state is LinkState.WRONG_VERSION and version == self.foreign_version:
            return []
        self.state = LinkState.WRONG_VERSION
        self.foreign_version = version
        text = f"the board uses version {version} of the protocol, this driver version {PROTOCOL_VERSION}"
        return [PortMessage(logging.ERROR, f"{text}: update the older one")]

    def _disconnect(self, loss: Loss, now_ns: int) -> list[Event]:
        was_ready = self.state is LinkState.READY
        self.state = LinkState.CONNECTING
        self.hello = None
        self.radio = None
        self.foreign_version = None
        for request in (self._mode_request, self._radio_request, self._offsets_request):
            request.sent.clear()
        self._sync_send_times_ns.clear()
        self._next_request_ns = now_ns
        return [loss] if was_ready else []

    def _send_sync(self, now_ns: int, stamp_ns: int) -> None:
        request = self._send(MessageType.TIME_SYNC, b"")
        if request is not None:
            _add_bounded(self._sync_send_times_ns, request, stamp_ns)
        self._num_syncs += 1
        interval_ns = FIRST_SYNC_INTERVAL_NS
        if self._num_syncs >= FIRST_SYNCS:
            interval_ns = round(SYNC_INTERVAL_NS * (0.7 + self._num_syncs * _GOLDEN_RATIO % 0.6))
        self._next_sync_ns = now_ns + interval_ns

    def _send(self, kind: MessageType, payload: bytes) -> int | None:
        """Queue a frame; return its sequence number, or None if the queue is full."""
        if len(self._outgoing) + len(payload) > _MAX_OUTGOING_BYTES:
            self.counts["unsent"] += 1
            return None
        sequence = self._encoder.sequence
        self._outgoing += self._encoder.encode(kind, payload)
        return sequence


def _add_bounded(memory: dict[_Key, _Value], key: _Key, value: _Value) -> None:
    """Add an entry to a dictionary of bounded size; the oldest entry is dropped."""
    memory[key] = value
    if len(memory) > _MAX_PENDING:
        del memory[next(iter(memory))]
