"""The host's state of a UCI board: start-up, supervision, end. No I/O, except for the file of the original calibration.

A `UciSession` takes received bytes and the time, and returns measurements and bytes to send. One ranging session is
opened for each peer: FiRa double-sided two-way ranging (deferred), SP3 frames, unicast.
"""

from __future__ import annotations

from collections import Counter

from uwb_mitigation.radios.capture import Session
from uwb_mitigation.radios.fira import codes
from uwb_mitigation.radios.fira.assembly import Assembly
from uwb_mitigation.radios.fira.calibration import Calibration, OriginalsFile
from uwb_mitigation.radios.fira.codes import DEVICE_READY, STATUS_OK, PacketType, SessionState
from uwb_mitigation.radios.fira.commands import Command, CommandSequence, Steps
from uwb_mitigation.radios.fira.packets import Packet, PacketDecoder
from uwb_mitigation.radios.fira.ranging import Ranging
from uwb_mitigation.radios.fira.settings import UciSettings
from uwb_mitigation.types.measurement import RangeMeasurement

__all__ = ["UciSession", "UciSettings"]

_MS = 10**6
RESET_NS = 150 * _MS
"""Timeout of a reset, which a board that is starting ignores."""

RESET_TRIES = 5
"""Number of resets after which a board that refuses them is used without."""

READY_NS = 600 * _MS
"""Timeout of the notification that a board is ready after a reset; it ignores commands before."""

MIN_PAUSE_NS, MAX_PAUSE_NS = 500 * _MS, 30_000 * _MS
"""Pause before a board or session is started again; it doubles until the board has ranged for `STABLE_NS`."""

STABLE_NS = 30_000 * _MS
SILENCE_NS = 1500 * _MS
"""Time without a notification, in addition to five intervals, after which the host asks whether the board works."""

_NO_ANSWER = "no answer to the reset: is this a board with UCI firmware?"
_TEXT_ANSWER = "the board has the CLI image or other firmware: it answers with text"
_NOT_CONNECTED = "not connected"
_COUNTS = (
    "ranges without_cir inconsistent_cir unknown_session duplicates restarts error_answers calibration_writes"
)


class UciSession(Session):
    """The host's side of one board.

    Call `receive` after each read, and at least every 50 ms; send `outgoing`. `now_ns` is monotonic, `stamp_ns` is
    the clock of the stamps.

    Args:
        settings: what the board does.
        originals: see `Calibration`. Without it, the device information is not requested.

    Attributes:
        state: problem, or an empty string while the board ranges.
        window: number of taps and lead that the board has confirmed; None = it did not answer.
        device_info: answer of the board to the request for its identity, not decoded.
        counts: numbers of messages, ranges and problems.
        starts: how often ranging was started.
        stopped: the commands of `stop` were answered.
        ranging: the sessions with the peers.
        assembly: the ranges that wait for their CIR, and what was found in them.
    """

    def __init__(self, settings: UciSettings, originals: OriginalsFile | None = None) -> None:
        super().__init__()
        settings.check()
        self.state = _NOT_CONNECTED
        self.window: tuple[int, int] | None = None
        self.device_info = b""
        self.starts = 0
        self.counts: Counter[str] = Counter(dict.fromkeys(_COUNTS.split(), 0))
        self.stopped = False
        self.ranging = Ranging(settings)
        self.assembly = Assembly(self.ranging, self.counts)
        self._decoder = PacketDecoder()
        self._commands = CommandSequence(self._finish, self._outgoing)
        self._calibration = Calibration(originals, self.counts)
        self._identifies = originals is not None
        self._ready = self._stopping = self._state_requested = False
        self._restart_ns: int | None = None
        self._pause_ns = MIN_PAUSE_NS
        self._received_ns = self._started_ns = 0

    @property
    def delivers(self) -> bool:
        """Whether the ranges of this board are published."""
        return self.settings.delivers

    @property
    def settings(self) -> UciSettings:
        """What the board does; other settings of `ranging` take effect with `opened`."""
        return self.ranging.settings

    def opened(self, now_ns: int) -> None:
        """Start the board after its port was opened."""
        self._decoder.reset()
        self._commands.cancel()
        self._begin(now_ns)

    def closed(self, now_ns: int) -> list[RangeMeasurement]:
        """Stop after the port was lost; return no measurements."""
        self._restart_ns = None
        self._commands.cancel()
        self._forget_sessions()
        self.state = _NOT_CONNECTED
        return []

    def stop(self, now_ns: int) -> None:
        """End all sessions and restore the calibration, before the port is closed; `stopped` follows."""
        self._stopping, self._restart_ns = True, None
        self._commands.start(self._shut_down(), now_ns)

    @property
    def is_waiting(self) -> bool:
        """Whether the session pauses before it starts the board again."""
        return self._restart_ns is not None

    @property
    def _is_unanswered(self) -> bool:
        return self.state == _NO_ANSWER or self.state.startswith(_TEXT_ANSWER)

    def totals(self) -> dict[str, int]:
        """Return all counts for diagnostics, {name: count}."""
        return {**self.counts, **self.ranging.totals(), **self._decoder.counts}

    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        """Handle received bytes and timeouts; return new measurements in the order of their arrival."""
        for packet in self._decoder.feed(data, now_ns):
            self._handle(packet, now_ns, stamp_ns)
        measurements = self.assembly.measurements(now_ns)
        if self._is_unanswered and (text := self._decoder.text):
            self.state = (
                f"{_TEXT_ANSWER} ({text!r}): flash the UCI image, or use source:=lines map:=dwm3001_cli"
            )
        self._commands.check_timeout(now_ns)
        self._supervise(now_ns)
        return measurements

    def _forget_sessions(self) -> None:
        self.ranging.forget()
        self.assembly.forget()

    def _begin(self, now_ns: int) -> None:
        """Start the board with a reset."""
        self.state = self.state if self.is_waiting else _NO_ANSWER
        self._forget_sessions()
        self._received_ns = now_ns
        self._restart_ns = None
        self._state_requested = self.stopped = self._stopping = False
        self._commands.start(self._start_up(), now_ns)

    def _schedule(self, reason: str, now_ns: int) -> None:
        """Start the board, or the sessions that have ended, again after a pause."""
        if self.is_waiting or self._stopping:
            return
        if self._started_ns and not self.state and now_ns - self._started_ns > STABLE_NS:
            self._pause_ns = MIN_PAUSE_NS
        self.state = f"{reason}; it is started again after {self._pause_ns / 1e9:g} s"
        self._restart_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, MAX_PAUSE_NS)

    def _start_up(self) -> Steps:
        """Send the commands that start ranging; return the problem, or an empty string."""
        # A board that is starting answers late: repeat the reset for as long as it takes.
        errors, tries = self.counts["error_answers"], 0
        self._ready = False
        while (yield Command(codes.RESET, b"\0", tries=1, timeout_ns=RESET_NS)) is None:
            tries += 1
            if tries >= RESET_TRIES and (self._ready or self.counts["error_answers"] > errors):
                break
            if tries == RESET_TRIES:
                self.state = _NO_ANSWER
            self._ready = False
        if not self._ready:
            yield Command(None, tries=1, timeout_ns=READY_NS)
        if self._is_unanswered:
            self.state = "the board has not confirmed its settings"
        if self._identifies:
            answer = yield Command(codes.DEVICE_INFO, tries=1)
            self.device_info = answer.payload[1:] if answer and answer.status == STATUS_OK else b""
            self._calibration.connected(self.device_info.hex())
        if self.settings.window:
            self.window = yield from self._calibration.set_window(self.settings.window)
        self.assembly.begin()
        return (yield from self.ranging.open_all())

    def _shut_down(self) -> Steps:
        yield from self.ranging.close_all()
        yield from self._calibration.restore()
        return _NOT_CONNECTED

    def _finish(self, problem: str, now_ns: int) -> None:
        """Range, or start again, after the last answer."""
        self.state = problem
        self._received_ns = self._started_ns = now_ns
        self.stopped = self._stopping
        if problem:
            self._started_ns = 0
            self._schedule(problem, now_ns)
        else:
            self.starts += 1

    def _supervise(self, now_ns: int) -> None:
        """Start the board again if it has ended a session, or sends no data."""
        if self._commands.command is not None:
            return
        if self._restart_ns is not None:
            if now_ns >= self._restart_ns:
                self._restart(now_ns)
        elif self.state != _NOT_CONNECTED:
            idle_ns = now_ns - self._received_ns
            limit_ns = SILENCE_NS + 5 * self.settings.effective_interval_ms * _MS
            if ended := self.ranging.ended:
                self._schedule(ended[0].ended, now_ns)
            elif idle_ns > 2 * limit_ns:
                self._schedule("the board sends no data", now_ns)
            elif idle_ns > limit_ns and not self._state_requested:
                # An anchor without its tag may have nothing to report: ask whether the board works.
                self._state_requested = True
                for session in self.ranging.sessions:
                    self._commands.queue(codes.GET_SESSION_STATE, session.packed)

    def _restart(self, now_ns: int) -> None:
        """Open the sessions that have ended, or start the board if it does not range at all."""
        self.counts["restarts"] += 1
        if self.ranging.ended and self._started_ns:
            self._restart_ns = None
            self.assembly.begin()
            self._commands.start(self.ranging.open_again(), now_ns)
        else:
            self._begin(now_ns)

    def _handle(self, packet: Packet, now_ns: int, stamp_ns: int) -> None:
        name, command = packet.name, self._commands.command
        if command is None:
            self._received_ns = now_ns
            self._state_requested = False
        if packet.kind is PacketType.RESPONSE:
            if name == codes.GET_SESSION_STATE and command is None:
                is_active = packet.payload[1:2] == bytes([SessionState.ACTIVE])
                # The firmware may have no such command, or no such session any more.
                if self.assembly.has_ranged if packet.status != STATUS_OK else not is_active:
                    self._started_ns = 0
                    self._schedule("the board has ended its sessions", now_ns)
            self._answer(name, packet, now_ns)
        elif name == codes.GENERIC_ERROR:
            if command is not None and command.name is not None:
                self._answer(command.name, packet, now_ns)
        elif name == codes.DEVICE_STATUS:
            self._ready = packet.status == DEVICE_READY
            if self._ready and command is not None and command.name is None:
                self._commands.advance(None, now_ns)
        elif name == codes.BOOT:
            if command is None:
                # The board has lost its sessions.
                self._schedule("the board has restarted by itself", now_ns)
                self._started_ns = 0
        elif name == codes.SESSION_STATUS:
            if not self._stopping:
                self.ranging.follow(packet)
        elif packet.content is not None:
            self.assembly.add(packet, self._decoder.damages, now_ns, stamp_ns)

    def _answer(self, name: tuple[int, int], packet: Packet, now_ns: int) -> None:
        if packet.status != STATUS_OK:
            self.counts["error_answers"] += 1
        command = self._commands.command
        is_refused_reset = name == codes.RESET and packet.status != STATUS_OK  # repeated after its timeout
        if command is not None and command.name == name and not is_refused_reset:
            self._commands.advance(packet, now_ns)
