"""Commands of the host to a UCI board, one after the other, each repeated until it is answered. No I/O."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

from uwb_mitigation.radios.fira.packets import Packet, encode_packets

ANSWER_NS = 500_000_000
"""Timeout of a command."""

TRIES = 3
MAX_OUTGOING_BYTES = 1 << 14


@dataclass(frozen=True, slots=True)
class Command:
    """A command, or a wait until the device is ready if it has no name."""

    name: tuple[int, int] | None
    payload: bytes = b""
    tries: int = TRIES
    timeout_ns: int = ANSWER_NS


Steps = Generator[Command, Packet | None, str]
"""Yields commands, receives their answers (None: no answer), and returns a problem, or an empty string."""


class CommandSequence:
    """Executes `Steps`.

    Args:
        on_end: called with the result of the steps and the time.
        outgoing: the bytes to send are appended to it.

    Attributes:
        command: the command that waits for its answer; None = no steps are executed.
    """

    def __init__(self, on_end: Callable[[str, int], None], outgoing: bytearray) -> None:
        self._outgoing = outgoing
        self.command: Command | None = None
        self._on_end = on_end
        self._steps: Steps | None = None
        self._remaining = self._due_ns = 0

    def start(self, steps: Steps, now_ns: int) -> None:
        """Execute these steps, and no others any more."""
        self._steps = steps
        self.advance(None, now_ns)

    def cancel(self) -> None:
        """Forget the steps and the bytes to send."""
        self._steps = self.command = None
        self._outgoing.clear()

    def advance(self, answer: Packet | None, now_ns: int) -> None:
        """Continue after an answer, or without one."""
        assert self._steps is not None
        try:
            self.command = self._steps.send(answer)
        except StopIteration as end:
            self._steps = self.command = None
            self._on_end(str(end.value), now_ns)
            return
        self._remaining = self.command.tries
        self._send(self.command, now_ns)

    def check_timeout(self, now_ns: int) -> None:
        """Repeat a command without an answer, or continue without it."""
        if self.command is None or now_ns < self._due_ns:
            return
        if self._remaining > 0:
            self._send(self.command, now_ns)
        else:
            self.advance(None, now_ns)

    def queue(self, name: tuple[int, int], payload: bytes) -> None:
        """Send a command whose answer is not awaited."""
        if len(self._outgoing) > MAX_OUTGOING_BYTES:
            # The port accepts no bytes.
            self._outgoing.clear()
        self._outgoing += encode_packets(*name, payload)

    def _send(self, command: Command, now_ns: int) -> None:
        self._remaining -= 1
        self._due_ns = now_ns + command.timeout_ns
        if command.name is not None:
            self.queue(command.name, command.payload)
