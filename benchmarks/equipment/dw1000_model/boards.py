"""Boards with the firmware's exchange on modelled chips, in virtual time, for benchmarks and tests."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint16, c_uint32, c_uint64, c_void_p
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER, model_objects
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.errors import LinkError
from uwb_mitigation.mitigation.embedded.compiling import (
    WARNINGS,
    Signatures,
    c_compiler,
    compile_objects,
    firmware_folder,
    load_library,
)
from uwb_mitigation.radios.settings import RadioSettings, RadioStatus
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.layout import MAX_PAYLOAD_BYTES, MessageType, Mode

NOMINAL_DELAY_TICKS = 16436
"""Antenna delay of a chip's transmitter, and of its receiver."""

_STORE_VALUES = 1 << 16
"""Capacity of the CIR store between two calls of `ranges`, int16 values; further CIRs are dropped."""

RANGE = np.dtype(
    [
        ("time_s", "<f8"),
        ("board", "<i4"),
        ("values", "<u4"),
        ("range_m", "<f8"),
        ("tag", "<u8"),
        ("anchor", "<u8"),
        ("device_time", "<u8"),
        ("rx_power_dbm", "<f4"),
        ("first_path_power_dbm", "<f4"),
        ("first_path_index", "<f4"),
        ("start_index", "<i4"),
        ("preamble_count", "<u2"),
        ("noise_threshold", "<u2"),
        ("at", "<u4"),
    ]
)
"""One range of a board, in virtual time; its CIR is `values` int16 values from index `at` of the store."""


@dataclass(frozen=True, slots=True)
class SerialLink:
    """Serial link of a board to its host, and timing of the board's processor.

    Attributes:
        baud: baud rate, ten bits a byte; frames are sent in the background.
        mode: mode of the board.
        inference_s: duration of a correction.
        overhead_s: time that the processor adds to each SPI transaction.
    """

    baud: float = 921_600
    mode: Mode = Mode.HOST
    inference_s: float = 0.0
    overhead_s: float = 0.0


class ModelledAir:
    """Several boards on one air. Not thread-safe.

    Args:
        seed: the same seed and calls give the same run.

    Raises:
        MissingDependencyError: no C compiler or no source checkout is available.
    """

    def __init__(self, seed: int = 1) -> None:
        self._library = _library()
        self._air = self._library.radio_air_new(seed, _STORE_VALUES)
        self._boards = 0

    def __enter__(self) -> ModelledAir:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._library.radio_air_free(self._air)

    def add(
        self,
        settings: RadioSettings,
        *,
        ppm: float = 0.0,
        clock_ticks: int = 0,
        delay_ticks: int = NOMINAL_DELAY_TICKS,
        serial_link: SerialLink | None = None,
    ) -> int:
        """Add a board, whose program starts with the next `run`, and return its number.

        Without a serial link, the board only ranges.
        """
        settings.check()
        _, payload = messages.encode(settings)
        board: int = self._library.radio_air_add_board(
            self._air,
            ppm,
            clock_ticks,
            delay_ticks,
            delay_ticks,
            payload,
            len(payload),
            0x9E3779B97F4A7C15 * (self._boards + 1) % 2**64,
        )
        self._boards += 1
        if serial_link is not None:
            self._library.radio_air_set_serial_link(
                self._air,
                board,
                serial_link.baud,
                int(serial_link.mode),
                serial_link.inference_s,
                serial_link.overhead_s,
            )
        return board

    def set_pair(self, a: int, b: int, pair: Pair | None) -> None:
        """Set the radio channel of two boards; with None they do not receive each other."""
        if pair is None:
            self._library.radio_air_remove_pair(self._air, a, b)
            return
        samples = None if pair.samples is None else np.ascontiguousarray(pair.samples, np.int16)
        self._library.radio_air_set_pair(
            self._air,
            a,
            b,
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

    def reset(self, board: int) -> None:
        """Reset a board's chip with its reset line, for 1 ms."""
        self._library.radio_air_reset(self._air, board)

    def run(self, seconds: float) -> float:
        """Advance the time; return the time reached, s."""
        reached: float = self._library.radio_air_run(self._air, seconds)
        return reached

    def ranges(self) -> tuple[NDArray[np.void], NDArray[np.int16]]:
        """Return the ranges since the last call: rows of `RANGE`, and the store of their CIRs."""
        rows, store = c_void_p(), c_void_p()
        count = self._library.radio_air_results(self._air, ctypes.byref(rows), ctypes.byref(store))
        # RANGE contains no pointers, so the bytes can be copied.
        ranges = np.frombuffer(ctypes.string_at(rows.value or 0, count * RANGE.itemsize), RANGE)
        values = np.frombuffer(ctypes.string_at(store.value or 0, 2 * _STORE_VALUES), "<i2")
        self._library.radio_air_clear_results(self._air)
        return ranges, values

    def counts(self, board: int) -> dict[str, int]:
        """Return the counts of exchanges of a board that has run; see `RadioStatus`."""
        buffer = ctypes.create_string_buffer(MAX_PAYLOAD_BYTES)
        count = self._library.radio_air_status(self._air, board, buffer)
        status = messages.decode(MessageType.RADIO_STATUS, buffer.raw[:count])
        assert isinstance(status, RadioStatus)
        return asdict(status)

    def address(self, board: int) -> int:
        """Return the active address; 0 before the board's program has started its chip."""
        address: int = self._library.radio_air_address(self._air, board)
        return address

    def write(self, board: int, data: bytes) -> None:
        """Send bytes to a board over its serial link; the board reads them between two exchanges."""
        if not self._library.radio_air_write(self._air, board, data, len(data)):
            raise LinkError(
                f"{len(data)} bytes for a modelled board that has not run", valid="fewer, or run it"
            )

    def read(self, board: int) -> bytes:
        """Return the bytes that a board has sent over its serial link."""
        buffer = ctypes.create_string_buffer(1 << 18)
        count = self._library.radio_air_read(self._air, board, buffer)
        return buffer.raw[:count]

    def measurements_lost(self, board: int) -> int:
        """Return the number of ranges dropped because the queue of a board's serial link was full."""
        lost: int = self._library.radio_air_measurements_lost(self._air, board)
        return lost


@functools.cache
def _library() -> ctypes.CDLL:
    firmware = firmware_folder()
    program = Path(__file__).with_name("radio_air.c")
    options = ("-std=c99", "-O1", "-fPIC", *WARNINGS, f"-I{MODEL_FOLDER}", f"-I{firmware / 'src'}")
    objects = compile_objects(c_compiler(), options, (program, *sorted((firmware / "src").glob("*.c"))))
    air, board = c_void_p, c_int
    signatures: Signatures = {
        "new": (c_void_p, (c_uint64, c_size_t)),
        "free": (None, (air,)),
        "add_board": (
            c_int,
            (air, c_double, c_uint64, c_uint16, c_uint16, c_char_p, c_size_t, c_uint64),
        ),
        "set_serial_link": (None, (air, board, c_double, c_int, c_double, c_double)),
        "set_pair": (
            None,
            (
                air,
                board,
                board,
                c_double,
                c_double,
                c_void_p,
                c_size_t,
                c_double,
                *(c_uint16,) * 3,
                c_double,
                c_double,
            ),
        ),
        "remove_pair": (None, (air, board, board)),
        "reset": (None, (air, board)),
        "run": (c_double, (air, c_double)),
        "results": (c_uint32, (air, POINTER(c_void_p), POINTER(c_void_p))),
        "clear_results": (None, (air,)),
        "status": (c_size_t, (air, board, c_void_p)),
        "address": (c_uint64, (air, board)),
        "write": (c_int, (air, board, c_char_p, c_size_t)),
        "read": (c_size_t, (air, board, c_void_p)),
        "measurements_lost": (c_uint64, (air, board)),
        "result_bytes": (c_size_t, ()),
    }
    return load_library("radio_air_", (*objects, *model_objects()), signatures)
