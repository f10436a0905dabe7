"""Compile the model for the host and declare its functions to ctypes."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

from uwb_mitigation.mitigation.embedded.compiling import (
    WARNINGS,
    Signatures,
    c_compiler,
    compile_objects,
    load_library,
)

_OPTIONS = ("-std=c11", "-O1", "-fPIC", *WARNINGS)


class PairConfig(ctypes.Structure):
    """`dw1000_pair_config`."""

    _fields_ = (
        ("distance_m", ctypes.c_double),
        ("excess_m", ctypes.c_double),
        ("iq", ctypes.c_void_p),
        ("samples", ctypes.c_size_t),
        ("first_path_index", ctypes.c_double),
        ("preamble_count", ctypes.c_uint16),
        ("noise_threshold", ctypes.c_uint16),
        ("std_noise", ctypes.c_uint16),
        ("loss", ctypes.c_double),
        ("damage", ctypes.c_double),
    )


class Request(ctypes.Structure):
    """`dw1000_request`."""

    _fields_ = (
        ("kind", ctypes.c_int32),
        ("line", ctypes.c_int32),
        ("now_s", ctypes.c_double),
        ("seconds", ctypes.c_double),
        ("out", ctypes.c_void_p),
        ("in_", ctypes.c_void_p),
        ("n", ctypes.c_size_t),
        ("hz", ctypes.c_uint32),
    )


NextRequest = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(Request))


MODEL_FOLDER = Path(__file__).with_name("chip")  # the C sources of the model


def model_objects() -> tuple[str, ...]:
    """Return the object files of the model for the host, compiled once per process.

    Raises:
        MissingDependencyError: no C compiler is installed.
        UwbMitigationError: the compilation fails.
    """
    sources = tuple(sorted(MODEL_FOLDER.glob("*.c")))
    return compile_objects(c_compiler(), (*_OPTIONS, f"-I{MODEL_FOLDER}"), sources)


@functools.cache
def load() -> ctypes.CDLL:
    """Load the model as a shared library.

    Raises:
        MissingDependencyError, UwbMitigationError: see `model_objects`.
    """
    pointer, real, size = ctypes.c_void_p, ctypes.c_double, ctypes.c_size_t
    signatures: Signatures = {
        "air_new": (pointer, (ctypes.c_uint64,)),
        "air_free": (None, (pointer,)),
        "chip_new": (pointer, (pointer, real, ctypes.c_uint64, ctypes.c_uint16, ctypes.c_uint16)),
        "set_pair": (None, (pointer, pointer, pointer, ctypes.POINTER(PairConfig))),
        "program": (None, (pointer, pointer, pointer)),
        "program_remote": (None, (pointer, NextRequest, pointer)),
        "run": (real, (pointer, real)),
        "spi": (None, (pointer, ctypes.c_char_p, ctypes.c_char_p, size, ctypes.c_uint32)),
        "irq": (ctypes.c_int, (pointer,)),
        "wait": (None, (pointer, real)),
        "delay": (None, (pointer, real)),
        "reset_pin": (None, (pointer,)),
        "reset_drive": (None, (pointer, ctypes.c_int)),
        "set_environment": (None, (pointer, real, real)),
        "set_edge_loss": (None, (pointer, real)),
        "program_otp": (None, (pointer, ctypes.c_uint, ctypes.c_uint32)),
        "sent_power": (None, (pointer, ctypes.POINTER(real), ctypes.POINTER(real))),
        "now": (real, (pointer,)),
        "fault": (ctypes.c_char_p, (pointer,)),
    }
    return load_library("dw1000_", model_objects(), signatures)
