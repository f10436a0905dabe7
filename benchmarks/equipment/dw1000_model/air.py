"""Air and chips. A chip is controlled by the caller or by programs that run in virtual time."""

from __future__ import annotations

import ctypes
import queue
import threading
from collections.abc import Callable
from typing import Protocol

import numpy as np

from benchmarks.equipment.dw1000_model.library import NextRequest, PairConfig, Request, load
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.errors import UwbMitigationError

ANTENNA_DELAY_TICKS = 16436
"""Antenna delay per direction that DecaRanging assumes at PRF 64 MHz."""

_POLL_S = 1e-6
_SPI, _DELAY, _WAIT, _RESET_PIN = range(4)


class Host(Protocol):
    """Interface of a driver to its host computer. Times are virtual, in s."""

    def spi(self, out: bytes, hz: int) -> bytes:
        """One chip-select period, full duplex."""
        ...

    def irq(self) -> bool:
        """The level of the IRQ line."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait until the IRQ line is high."""
        ...

    def delay(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def reset_pin(self) -> None:
        """Pull RSTn low for 1 ms, and let it float."""
        ...

    def now(self) -> float:
        """Time since the start of the air, s."""
        ...


class Air:
    """Several chips in virtual time. `close`, or leaving the context, stops their programs.

    Not thread-safe.

    Args:
        seed: seed of all random numbers: the same seed and programs give the same run.

    Raises:
        MissingDependencyError, UwbMitigationError: the model cannot be compiled.
    """

    def __init__(self, seed: int = 0) -> None:
        self._library = load()
        self._air: int | None = self._library.dw1000_air_new(seed)
        if self._air is None:
            raise UwbMitigationError("no memory for the model")
        self._programs: dict[int, _Program] = {}

    def chip(
        self,
        *,
        ppm: float = 0.0,
        clock_ticks: int = 0,
        tx_delay_ticks: int = ANTENNA_DELAY_TICKS,
        rx_delay_ticks: int = ANTENNA_DELAY_TICKS,
    ) -> Chip:
        """Add a chip; `dw1000_chip_new` in C."""
        chip = self._library.dw1000_chip_new(self._air, ppm, clock_ticks, tx_delay_ticks, rx_delay_ticks)
        if chip is None:
            raise UwbMitigationError("no memory for a chip")
        return Chip(self, self._library, chip)

    def set_pair(self, a: Chip, b: Chip, pair: Pair | None) -> None:
        """Set the radio channel of two chips; with None they do not receive each other."""
        config = None
        if pair is not None:
            samples = None if pair.samples is None else np.ascontiguousarray(pair.samples, np.int16)
            config = PairConfig(
                pair.distance_m,
                pair.excess_m,
                None if samples is None else samples.ctypes.data,
                0 if samples is None else len(samples) // 2,
                pair.first_path_index,
                pair.preamble_count,
                pair.noise_threshold,
                pair.std_noise,
                pair.loss,
                pair.damage,
            )
        self._library.dw1000_set_pair(
            self._air, a.address, b.address, None if config is None else ctypes.byref(config)
        )

    def run(self, seconds: float) -> float:
        """Advance the time, or stop when all programs have ended; return the time reached, s.

        Raises:
            Exception: the exception that a program raised.
        """
        reached: float = self._library.dw1000_run(self._air, seconds)
        for program in self._programs.values():
            program.raise_failure()
        return reached

    def program(self, chip: Chip, run: Callable[[Host], None]) -> None:
        """Start a program on a chip's host; it replaces the previous one.

        It has its own thread, which runs only while the air and all other programs are paused.
        """
        old = self._programs.pop(chip.address, None)
        if old is not None:
            old.end()
        program = _Program(run)
        self._programs[chip.address] = program
        self._library.dw1000_program_remote(chip.address, program.callback, None)

    def close(self) -> None:
        """Stop all programs and free the air; may be called twice."""
        if self._air is not None:
            for program in self._programs.values():
                program.end()
            self._library.dw1000_air_free(self._air)
            self._air = None

    def __enter__(self) -> Air:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Chip:
    """A chip controlled by the caller, as a `Host`; during its calls, all programs continue."""

    def __init__(self, air: Air, library: ctypes.CDLL, address: int) -> None:
        self.air = air
        self.address = address
        self._library = library

    def spi(self, out: bytes, hz: int) -> bytes:
        """One chip-select period, full duplex."""
        buffer = ctypes.create_string_buffer(len(out))
        self._library.dw1000_spi(self.address, out, buffer, len(out), hz)
        return buffer.raw

    def irq(self) -> bool:
        """The level of the IRQ line."""
        return bool(self._library.dw1000_irq(self.address))

    def wait(self, timeout_s: float) -> None:
        """Wait until the IRQ line is high."""
        self._library.dw1000_wait(self.address, timeout_s)

    def delay(self, seconds: float) -> None:
        """Let time pass."""
        self._library.dw1000_delay(self.address, seconds)

    def reset_pin(self) -> None:
        """Pull RSTn low for 1 ms, and let it float."""
        self._library.dw1000_reset_pin(self.address)

    def reset_drive(self, level: int) -> None:
        """Set RSTn permanently: 0 low, 1 floating, 2 high, which destroys the chip."""
        self._library.dw1000_reset_drive(self.address, level)

    def set_environment(self, celsius: float, volts: float) -> None:
        """Set the values that the chip's sensors measure."""
        self._library.dw1000_set_environment(self.address, celsius, volts)

    def set_edge_loss(self, probability: float) -> None:
        """Set the fraction of good frames in which the detector finds no leading edge."""
        self._library.dw1000_set_edge_loss(self.address, probability)

    def program_otp(self, address: int, word: int) -> None:
        """Set a word of the OTP memory; registers loaded from it change at the next reset."""
        self._library.dw1000_program_otp(self.address, address, word)

    @property
    def sent_power_db(self) -> tuple[float, float]:
        """Return the transmit power of the last frame, (preamble and data, PHR), dB above the lowest TX_POWER."""
        data, header = ctypes.c_double(), ctypes.c_double()
        self._library.dw1000_sent_power(self.address, ctypes.byref(data), ctypes.byref(header))
        return data.value, header.value

    def now(self) -> float:
        """Time since the start of the air, s."""
        now: float = self._library.dw1000_now(self.address)
        return now

    @property
    def fault(self) -> str | None:
        """Cause of the destruction of the chip; None = the chip works."""
        fault = self._library.dw1000_fault(self.address)
        return None if fault is None else fault.decode()


class _Ended(BaseException):
    """Raised in a program's thread to stop it."""


class _Program:
    """A `Host` whose thread runs only while the model waits for its next request."""

    def __init__(self, run: Callable[[Host], None]) -> None:
        self._run = run
        self._requests: queue.SimpleQueue[tuple[int, float, bytes, int] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._request = Request()
        self._references: list[object] = []
        self._read = ctypes.create_string_buffer(0)
        self._failure: BaseException | None = None
        self._ended = False
        self._thread: threading.Thread | None = None
        self.callback = NextRequest(self._next_request)

    def spi(self, out: bytes, hz: int) -> bytes:
        self._send_request(_SPI, 0.0, bytes(out), hz)
        return self._read.raw

    def irq(self) -> bool:
        # As in C: polling takes time, so that a polling loop advances the virtual time.
        self._send_request(_DELAY, _POLL_S)
        return bool(self._request.line)

    def wait(self, timeout_s: float) -> None:
        self._send_request(_WAIT, timeout_s)

    def delay(self, seconds: float) -> None:
        self._send_request(_DELAY, seconds)

    def reset_pin(self) -> None:
        self._send_request(_RESET_PIN, 0.0)

    def now(self) -> float:
        self._send_request(_DELAY, _POLL_S)
        return float(self._request.now_s)

    def end(self) -> None:
        """Stop the thread."""
        self._ended = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._answers.put(False)
            self._thread.join()
            self._thread = None

    def raise_failure(self) -> None:
        """Raise the exception of the program, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _send_request(self, kind: int, seconds: float, out: bytes = b"", hz: int = 0) -> None:
        self._requests.put((kind, seconds, out, hz))
        if not self._answers.get():
            raise _Ended

    def _run_thread(self) -> None:
        try:
            self._run(self)
        except _Ended:
            return
        except BaseException as failure:  # `run` raises it
            self._failure = failure
        self._requests.put(None)

    def _next_request(self, _context: object, request: ctypes._Pointer[Request]) -> int:
        if self._ended:
            return 0
        c_request = request.contents
        self._request.line, self._request.now_s = c_request.line, c_request.now_s
        if self._thread is None:
            self._thread = threading.Thread(target=self._run_thread, name="dw1000 host", daemon=True)
            self._thread.start()
        else:
            self._answers.put(True)
        next_request = self._requests.get()
        if next_request is None:
            self._thread.join()
            self._thread = None
            self._ended = True
            return 0
        c_request.kind, c_request.seconds, out, c_request.hz = next_request
        self._read = ctypes.create_string_buffer(len(out))
        self._references = [out]
        c_request.out = ctypes.cast(ctypes.c_char_p(out), ctypes.c_void_p)
        c_request.in_ = ctypes.cast(self._read, ctypes.c_void_p)
        c_request.n = len(out)
        return 1
