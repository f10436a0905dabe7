"""The firmware's C, compiled for this computer: a backend in place of ONNX Runtime, and for tests of parity."""

from __future__ import annotations

import ctypes
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.firmware_export.compiling import (
    WARNINGS,
    c_compiler,
    compile_objects,
    firmware_folder,
    run,
)
from uwb_mitigation.firmware_export.export import export_bundle
from uwb_mitigation.measurement import Cir, CorrectedColumns, RangeColumns, Status
from uwb_mitigation.mitigation import Backend, passed_through
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.offsets import NO_OFFSETS, Offsets

_OPTIONS = ("-std=c99", "-O3", "-fPIC", *WARNINGS)

_SHIM = (
    '#include "uwb_model.h"\n'
    "const uwb_model *uwb_exported_model(void);\n"
    "const uwb_model *uwb_exported_model(void) { return &uwb_model_data; }\n"
)


class _Cir(ctypes.Structure):
    _fields_ = (
        ("samples", ctypes.POINTER(ctypes.c_int16)),
        ("count", ctypes.c_size_t),
        ("encoding", ctypes.c_int),
        ("start_index", ctypes.c_int32),
        ("first_path_index", ctypes.c_float),
        ("scale", ctypes.c_float),
        ("preamble_count", ctypes.c_uint16),
        ("rx_power_dbm", ctypes.c_float),
        ("first_path_power_dbm", ctypes.c_float),
    )


class _Corrected(ctypes.Structure):
    _fields_ = (
        ("range_m", ctypes.c_float),
        ("correction_m", ctypes.c_float),
        ("variance_m2", ctypes.c_float),
        ("status", ctypes.c_int),
    )


class HostFirmware:
    """An exported model in the portable C library.

    Args:
        export: folder with `uwb_model.h`.
        build: folder for the shared library.
        flags: further compiler flags.

    Raises:
        MissingDependencyError: there is no C compiler.
        UwbMitigationError: it does not compile; carries the compiler's first error.
    """

    def __init__(self, export: Path, build: Path, flags: Sequence[str] = ()) -> None:
        library = ctypes.CDLL(str(build_shared_library(export, build, flags)))
        library.uwb_exported_model.restype = ctypes.c_void_p
        library.uwb_arena_size.restype = ctypes.c_size_t
        library.uwb_arena_size.argtypes = (ctypes.c_void_p,)
        library.uwb_network.argtypes = (
            *(ctypes.c_void_p,) * 3,
            ctypes.c_size_t,
            ctypes.POINTER(ctypes.c_float),
        )
        library.uwb_correct.argtypes = (
            ctypes.c_void_p,
            ctypes.c_float,
            ctypes.c_float,
            ctypes.POINTER(_Cir),
            ctypes.c_void_p,
            ctypes.c_size_t,
            ctypes.POINTER(_Corrected),
        )
        self._library = library
        self._model = library.uwb_exported_model()
        self.arena_bytes: int = library.uwb_arena_size(self._model)
        self._arena = ctypes.create_string_buffer(self.arena_bytes)

    def predict_m(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's outputs, float32 (n,), for windows float32 (n, K), m."""
        windows = np.ascontiguousarray(windows, np.float32)
        outputs = np.empty(len(windows), np.float32)
        value = ctypes.c_float()
        for index, window in enumerate(windows):
            status = self._library.uwb_network(
                self._model, window.ctypes.data, self._arena, self.arena_bytes, ctypes.byref(value)
            )
            if status:
                raise ModelError(f"the firmware refuses the model: status {status}")
            outputs[index] = value.value
        return outputs

    def correct(self, range_m: float, cir: Cir, offset_m: float = 0.0) -> tuple[float, float, float, int]:
        """Range, correction, variance and status, as in `CorrectedRange`."""
        result = _Corrected()
        self._library.uwb_correct(
            self._model,
            range_m,
            offset_m,
            ctypes.byref(_c_cir(cir)),
            self._arena,
            self.arena_bytes,
            ctypes.byref(result),
        )
        return result.range_m, result.correction_m, result.variance_m2, result.status


def build_shared_library(export: Path, build: Path, flags: Sequence[str] = ()) -> Path:
    """Compile the library and the model in `export` to a shared library in `build`."""
    shim = build / "exported_model.c"
    shim.write_text(_SHIM, encoding="utf-8")
    return link(shim, export, build / "libuwb_mitigation.so", flags, shared=True)


def link(
    program: Path, export: Path, output: Path, flags: Sequence[str] = (), *, shared: bool = False
) -> Path:
    """Link one C file, which includes the model in `export`, with the library, for this computer."""
    objects = library_objects(flags)
    options = (*_OPTIONS, *flags, f"-I{firmware_folder() / 'src'}", f"-I{export}")
    kind = ("-shared",) if shared else ()
    run([*c_compiler(), *options, *kind, str(program), *objects, "-o", str(output), "-lm"])
    return output


def library_objects(flags: Sequence[str] = ()) -> tuple[str, ...]:
    """The object files of the portable library for this computer; compiled once a process."""
    sources = firmware_folder() / "src"
    options = (*_OPTIONS, *flags, f"-I{sources}")
    return compile_objects(c_compiler(), options, tuple(sorted(sources.glob("*.c"))))


def _c_cir(cir: Cir) -> _Cir:
    samples = np.ascontiguousarray(cir.samples, np.int16)
    result = _Cir(
        samples.ctypes.data_as(ctypes.POINTER(ctypes.c_int16)),
        len(samples),
        int(cir.encoding),
        cir.start_index,
        cir.first_path_index if math.isfinite(cir.first_path_index) else math.nan,
        cir.scale,
        cir.preamble_count,
        cir.rx_power_dbm,
        cir.first_path_power_dbm,
    )
    # The structure holds a bare pointer: keep what it points to.
    result.owner = samples
    return result


class FirmwareMitigation(Backend):
    """Corrects ranges with one bundle as `Mitigation` does, to the same bits, by the firmware.

    Raises:
        MissingDependencyError: there is no C compiler, or the firmware's sources are not installed.
        ModelError: the firmware cannot run the bundle's network.
        UwbMitigationError: the sources do not compile.
    """

    def __init__(self, bundle: Bundle, offsets: Offsets = NO_OFFSETS) -> None:
        self.bundle = bundle
        self.offsets = offsets
        # The loaded library does not need its file any more.
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_backend_") as name:
            folder = Path(name)
            export_bundle(bundle, folder)
            self._firmware = HostFirmware(folder, folder)

    def correct_columns(self, ranges: RangeColumns) -> CorrectedColumns:
        """See `Backend`."""
        offset = self.offsets.of(ranges.tag_id, ranges.anchor_id)
        *values, status = zip(
            *(
                self._firmware.correct(float(ranges.range_m[row]), _cir(ranges, row), float(offset[row]))
                for row in range(len(ranges))
            ),
            strict=True,
        )
        found = passed_through(self.bundle, ranges, offset, np.array(status, np.uint8))
        is_corrected = found.status == Status.OK
        for column, computed in zip(
            (found.range_m, found.correction_m, found.variance_m2), values, strict=True
        ):
            column[is_corrected] = np.array(computed, np.float32)[is_corrected]
        return found


def _cir(ranges: RangeColumns, row: int) -> Cir:
    return Cir(
        samples=ranges.samples[row],
        encoding=ranges.encoding,
        start_index=int(ranges.start_index[row]),
        first_path_index=float(ranges.first_path_index[row]),
        scale=float(ranges.scale[row]),
        preamble_count=int(ranges.preamble_count[row]),
        rx_power_dbm=float(ranges.rx_power_dbm[row]),
        first_path_power_dbm=float(ranges.first_path_power_dbm[row]),
    )
