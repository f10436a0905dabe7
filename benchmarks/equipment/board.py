"""The board's side of the protocol. No I/O.

The emulated board runs it; it is also the shortest reference implementation for firmware.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, FrameEncoder, WireFrame
from uwb_mitigation.radios.wire.layout import (
    MAX_OFFSETS,
    MAX_PAYLOAD_BYTES,
    PROTOCOL_VERSION,
    Flag,
    MessageType,
    Mode,
)
from uwb_mitigation.radios.wire.messages import (
    BoardStatus,
    Correction,
    Hello,
    OffsetsAnswer,
    TimeSyncReply,
)
from uwb_mitigation.types.measurement import CorrectedRange, RangeMeasurement
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets

STATUS_INTERVAL_US = 1_000_000

_UNSOLICITED = Flag(0)


class Corrector(Protocol):
    """Corrects ranges on the board, such as `Mitigation`."""

    offsets: Offsets

    def correct(self, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]:
        """Return a corrected range for each measurement."""


class Board:
    """A board from one boot to the next reset. `now_us` is its uptime.

    Every method returns the bytes to send: complete frames.

    Args:
        identity: the HELLO; fields that depend on the state of the board are replaced.
        corrector: the board's model; None = no model, and all modes but HOST are refused. The host sets its offsets,
            which are empty after boot.
        mode: the mode after boot.
        boot_id: differs between two boots.
        version: protocol version of the board; to test a mismatch, use another than the host's.
    """

    def __init__(
        self,
        identity: Hello,
        corrector: Corrector | None = None,
        *,
        mode: Mode = Mode.HOST,
        boot_id: int = 1,
        version: int = PROTOCOL_VERSION,
    ) -> None:
        self._identity = identity
        self._corrector = corrector
        if corrector is not None:
            corrector.offsets = NO_OFFSETS
        self._boot_id = boot_id
        self._decoder = FrameDecoder()
        self._encoder = FrameEncoder(version)
        self._status_due_us = STATUS_INTERVAL_US
        self._dropped = 0
        self._measurements = 0
        self.mode = mode if corrector is not None else Mode.HOST
        self.measurements_lost = 0

    def hello(self, now_us: int) -> bytes:
        """Return the HELLO after boot."""
        return self._hello(now_us, None)

    def measure(self, measurement: RangeMeasurement, now_us: int) -> bytes:
        """Send a measurement received at `now_us`, raw or corrected according to the mode."""
        self._measurements += 1
        kind, payload = messages.encode(measurement)
        if self.mode is Mode.HOST:
            return self._encoder.encode(kind, payload, time_us=now_us)
        # A board computes with the same binary32 values that it would send.
        decoded = messages.decode(kind, payload)
        assert isinstance(decoded, RangeMeasurement)
        return self._correct(decoded, now_us, _UNSOLICITED)

    def tick(self, now_us: int) -> bytes:
        """Return the STATUS if it is due."""
        if now_us < self._status_due_us:
            return b""
        self._status_due_us = now_us + STATUS_INTERVAL_US
        received = self._decoder
        status = BoardStatus(
            frames_received=received.counts["frames"],
            frames_dropped=received.corrupt + self._dropped,
            measurements=self._measurements,
            measurements_lost=self.measurements_lost,
            mode=self.mode,
        )
        return self._send(status, now_us)

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Return the answers to the host's frames in the data."""
        foreign = self._decoder.counts["foreign_version"]
        sent = b"".join(self._answer(frame, now_us) for frame in self._decoder.feed(data))
        if self._decoder.counts["foreign_version"] > foreign:
            # This frame shows the board's version to a host of another version.
            sent += self.hello(now_us)
        return sent

    def _answer(self, frame: WireFrame, now_us: int) -> bytes:
        try:
            message = messages.decode(frame.type, frame.payload)
        except LinkError:
            message = None
        if message is MessageType.GET_INFO:
            return self._hello(now_us, frame.sequence)
        if isinstance(message, Mode):
            if self._corrector is not None or message is Mode.HOST:
                self.mode = message
            return self._hello(now_us, frame.sequence)
        if isinstance(message, Offsets):
            accepted = len(message) <= MAX_OFFSETS
            if accepted and self._corrector is not None:
                self._corrector.offsets = message
            return self._send(OffsetsAnswer(frame.sequence, MAX_OFFSETS, accepted), now_us, Flag.ANSWER)
        if message is MessageType.TIME_SYNC:
            return self._send(TimeSyncReply(frame.sequence, now_us), now_us, Flag.ANSWER)
        if isinstance(message, RangeMeasurement) and self._corrector is not None:
            return self._correct(message, now_us, Flag.ANSWER)
        self._dropped += 1
        return b""

    def _correct(self, measurement: RangeMeasurement, now_us: int, flags: Flag) -> bytes:
        if self._corrector is None:
            return b""
        began_ns = time.perf_counter_ns()
        corrected = self._corrector.correct([measurement])[0]
        correction = Correction(
            0,
            measurement.tag_id,
            measurement.anchor_id,
            measurement.sequence,
            measurement.device_time,
            corrected,
            compute_us=(time.perf_counter_ns() - began_ns) // 1000,
        )
        return self._send(correction, now_us, flags)

    def _hello(self, now_us: int, request: int | None) -> bytes:
        hello = replace(
            self._identity,
            mode=self.mode,
            boot_id=self._boot_id,
            request_sequence=request or 0,
            max_payload=MAX_PAYLOAD_BYTES,
        )
        return self._send(hello, now_us, _UNSOLICITED if request is None else Flag.ANSWER)

    def _send(self, message: messages.Message, now_us: int, flags: Flag = _UNSOLICITED) -> bytes:
        kind, payload = messages.encode(message)
        return self._encoder.encode(kind, payload, flags=flags, time_us=now_us)
