"""An emulated board whose firmware fails: it hangs, sends noise, or speaks another version of the protocol."""

from __future__ import annotations

import time

from benchmarks.equipment.board import Board
from benchmarks.equipment.emulated_board import EmulatedBoard
from uwb_mitigation.radios.wire.layout import PROTOCOL_VERSION

_FLOOD_BYTES = 4096


class FaultyBoard(EmulatedBoard):
    """See `EmulatedBoard`.

    Args:
        version: protocol version that the board speaks.
        boot_noise: bytes of noise before each HELLO.
    """

    def __init__(self, *arguments, version: int = PROTOCOL_VERSION, boot_noise: int = 0, **options) -> None:
        self._version, self._boot_noise = version, boot_noise
        self._mute_until = self._flood_until = 0.0
        super().__init__(*arguments, **options)

    def mute(self, seconds: float) -> None:
        """Send nothing for a while, as firmware that hangs."""
        with self._lock:
            self._mute_until = time.monotonic() + seconds
            self._backlog.clear()

    def flood(self, seconds: float) -> None:
        """Send noise as fast as the port accepts it."""
        with self._lock:
            self._flood_until = time.monotonic() + seconds

    def reset(self) -> None:
        # The thread of the board must not write the backlog while it grows.
        with self._lock:
            super().reset()
            self._backlog[:0] = self._random.bytes(self._boot_noise)

    def _create_board(self) -> Board:
        return Board(
            self._identity, self._corrector, mode=self._mode, boot_id=self._boots, version=self._version
        )

    def _exchange(self, timeout_s: float) -> None:
        with self._lock:
            if time.monotonic() < self._flood_until and len(self._backlog) < _FLOOD_BYTES:
                self._backlog += self._random.bytes(_FLOOD_BYTES)
        super()._exchange(timeout_s)

    def _transmit(self, data: bytes) -> None:
        if time.monotonic() >= self._mute_until:
            super()._transmit(data)
