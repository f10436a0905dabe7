"""The firmware compiled for this computer: a backend instead of ONNX Runtime, also used in parity tests."""

from __future__ import annotations

import ctypes
import math
import tempfile
from collections.abc import Sequence
from ctypes import POINTER, byref, c_float, c_int, c_int32, c_size_t, c_uint16, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.correction import Corrector, pass_through
from uwb_mitigation.mitigation.embedded import compiling
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.types.measurement import CORRECTED, Cir, CirFault, CorrectedColumns, RangeColumns, Status

_OPTIONS = ("-std=c99", "-O3", "-fPIC", *compiling.WARNINGS)

_SHIM = (
    '#include "uwb_model.h"\n'
    "const uwb_model *uwb_exported_model(void);\n"
    "const uwb_model *uwb_exported_model(void) { return &uwb_model_data; }\n"
)


class _Cir(ctypes.Structure):
    """`uwb_cir`."""

    _fields_ = (
        ("samples", c_void_p),
        ("count", c_size_t),
        ("encoding", c_int),
        ("start_index", c_int32),
        ("first_path_index", c_float),
        ("scale", c_float),
        ("preamble_count", c_uint16),
        ("rx_power_dbm", c_float),
        ("first_path_power_dbm", c_float),
    )


class _Corrected(ctypes.Structure):
    """`uwb_corrected`."""

    _fields_ = (("range_m", c_float), ("correction_m", c_float), ("variance_m2", c_float), ("status", c_int))


_SIGNATURES: compiling.Signatures = {
    "exported_model": (c_void_p, ()),
    "arena_size": (c_size_t, (c_void_p,)),
    "network": (c_int, (c_void_p, c_void_p, c_void_p, c_size_t, POINTER(c_float))),
    "correct": (None, (c_void_p, c_float, c_float, POINTER(_Cir), c_void_p, c_size_t, POINTER(_Corrected))),
}


class CompiledFirmware:
    """An exported model in the portable C library.

    Args:
        export: folder with `uwb_model.h`.
        build: folder for the shared library.
        flags: further compiler flags.

    Raises:
        MissingDependencyError: no C compiler is installed.
        UwbMitigationError: the compilation fails; the message contains the compiler's first error.
    """

    def __init__(self, export: Path, build: Path, flags: Sequence[str] = ()) -> None:
        shim = build / "exported_model.c"
        shim.write_text(_SHIM, encoding="utf-8")
        path = link(shim, export, build / "libuwb_mitigation.so", flags, compiling.CORRECTION, shared=True)
        self._library = compiling.declare(ctypes.CDLL(str(path)), "uwb_", _SIGNATURES)
        self._model = self._library.uwb_exported_model()
        self._arena_bytes: int = self._library.uwb_arena_size(self._model)
        self._arena = ctypes.create_string_buffer(self._arena_bytes)

    def predict_m(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the network's outputs, float32 (n,), m, for windows, float32 (n, K)."""
        windows = np.ascontiguousarray(windows, np.float32)
        outputs = np.empty(len(windows), np.float32)
        value = c_float()
        for index, window in enumerate(windows):
            status = self._library.uwb_network(
                self._model, window.ctypes.data, self._arena, self._arena_bytes, byref(value)
            )
            if status:
                raise ModelError(f"the firmware rejects the model: status {status}")
            outputs[index] = value.value
        return outputs

    def correct(self, range_m: float, cir: Cir, offset_m: float = 0.0) -> tuple[float, float, float, int]:
        """Return range, correction, variance and status, as in `CorrectedRange`."""
        samples = np.ascontiguousarray(cir.samples, np.int16)
        values = {name: getattr(cir, name) for name, _ in _Cir._fields_[2:]}
        if not math.isfinite(cir.first_path_index):
            values["first_path_index"] = math.nan
        c_cir, result = _Cir(samples.ctypes.data, len(samples), **values), _Corrected()
        arena = self._arena, self._arena_bytes
        self._library.uwb_correct(self._model, range_m, offset_m, byref(c_cir), *arena, byref(result))
        return result.range_m, result.correction_m, result.variance_m2, result.status


def link(
    program: Path,
    export: Path,
    output: Path,
    flags: Sequence[str] = (),
    sources: str = "*.c",
    *,
    shared: bool = False,
) -> Path:
    """Link a C file that includes the model in `export` with the library, for this computer."""
    objects = library_objects(flags, sources)
    options = (*_OPTIONS, *flags, f"-I{compiling.firmware_folder() / 'src'}", f"-I{export}")
    kind = ("-shared",) if shared else ()
    compiling.run_tool(
        [*compiling.c_compiler(), *options, *kind, str(program), *objects, "-o", str(output), "-lm"]
    )
    return output


def library_objects(flags: Sequence[str] = (), sources: str = "*.c") -> tuple[str, ...]:
    """Return the object files of the portable library for this computer, compiled once per process."""
    folder = compiling.firmware_folder() / "src"
    options = (*_OPTIONS, *flags, f"-I{folder}")
    return compiling.compile_objects(compiling.c_compiler(), options, tuple(sorted(folder.glob(sources))))


class FirmwareBackend:
    """Runs a model in the firmware."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        # The loaded library no longer needs its file.
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_backend_") as name:
            folder = Path(name)
            export_bundle(bundle, folder)
            self._firmware = CompiledFirmware(folder, folder)

    def correct(self, ranges: RangeColumns, offset_m: NDArray[np.float32]) -> CorrectedColumns:
        """See `Backend`."""
        *values, status = zip(
            *(
                self._firmware.correct(float(ranges.range_m[row]), _cir(ranges, row), float(offset_m[row]))
                for row in range(len(ranges))
            ),
            strict=True,
        )
        # The firmware returns no fault, and gets no magnitudes in dB on a board.
        faults, _ = self.bundle.card.preprocessing.apply(ranges)
        statuses = np.where(faults == CirFault.DECIBELS, Status.BAD_CIR, status).astype(np.uint8)
        corrected = pass_through(self.bundle, ranges, offset_m, statuses, faults)
        is_corrected = np.isin(corrected.status, CORRECTED)
        for column, computed in zip(
            (corrected.range_m, corrected.correction_m, corrected.variance_m2), values, strict=True
        ):
            column[is_corrected] = np.array(computed, np.float32)[is_corrected]
        return corrected


class FirmwareMitigation(Corrector):
    """Corrects ranges in the firmware; bit-identical to `Mitigation`.

    Raises:
        MissingDependencyError: no C compiler is installed, or the firmware's sources are not installed.
        ModelError: the firmware cannot run the network of a model.
        UwbMitigationError: the sources do not compile.
    """

    _backend = FirmwareBackend


def _cir(ranges: RangeColumns, row: int) -> Cir:
    values: dict[str, Any] = {
        name: (float if kind is c_float else int)(getattr(ranges, name)[row])
        for name, kind in _Cir._fields_[3:]
    }
    return Cir(ranges.samples[row], ranges.encoding, **values)
