"""Arrays of ranges and CIRs from a caller, checked and converted to columns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, check_name
from uwb_mitigation.types.measurement import (
    LINEAR_MAGNITUDES,
    MAX_REACH_M,
    Encoding,
    RangeColumns,
    int16_samples,
    is_logarithmic,
)

_ROWS = 128
"""Number of rows of arrays that are converted at a time: more are hardly faster."""

_DEFAULTS = dict.fromkeys(("start_index", "preamble_count"), 0.0)
_DEFAULTS |= dict.fromkeys(("rx_power_dbm", "first_path_power_dbm"), math.nan)
_DEFAULTS |= dict.fromkeys(("tag_id", "anchor_id"), 0)
_CONSTANTS = ("radio", "segment")


def columns_of_arrays(range_m: Any, cir: Any, first_path_index: Any, **fields: Any) -> Iterator[RangeColumns]:
    """Yield the columns of n ranges from arrays, `_ROWS` at a time, which bounds the memory; numbers are valid for all ranges.

    The arguments are those of `Mitigation.correct_arrays`.

    Raises:
        ParameterError: see `Mitigation.correct_arrays`.
    """
    samples = _checked_samples(cir)
    for name in fields:
        check_name("field", name, (*_DEFAULTS, *_CONSTANTS))
    constants = {name: fields.pop(name) for name in _CONSTANTS if name in fields}

    def column(name: str, value: Any) -> NDArray[Any]:
        dtype: Any = np.uint64 if name in ("tag_id", "anchor_id") else np.float64
        try:
            return np.broadcast_to(np.asarray(value, dtype), len(samples))
        except (ValueError, TypeError, OverflowError) as error:
            shape = f"{name} of shape {np.shape(value)} with a cir of shape {samples.shape}"
            raise ParameterError(shape, valid="one number, or one for each row of the cir") from error

    values = {"range_m": range_m, "first_path_index": first_path_index, **_DEFAULTS, **fields}
    columns: dict[str, Any] = {name: column(name, value) for name, value in values.items()}
    index = columns["first_path_index"] - columns["start_index"]
    _check_units(columns["range_m"], index, samples.shape[1])
    encoding = Encoding.COMPLEX_INT16 if np.iscomplexobj(samples) else Encoding.MAGNITUDE
    for start in range(0, max(len(samples), 1), _ROWS):
        rows = slice(start, start + _ROWS)
        int16, scale = int16_samples(samples[rows])
        yield RangeColumns(
            encoding=encoding,
            samples=int16,
            scale=scale,
            **{name: values[rows] for name, values in columns.items()},
            **constants,
        )


def _checked_samples(cir: Any) -> NDArray[Any]:
    """Return the samples (n, m) of n CIRs from a caller; raises ParameterError, see `columns_of_arrays`."""
    try:
        samples = np.asarray(cir)
    except ValueError as error:
        raise ParameterError("rows of the cir have different lengths", valid="(n, m) samples") from error
    if not np.issubdtype(samples.dtype, np.number):
        raise ParameterError(f"cir of type {samples.dtype}", valid="real or complex numbers")
    if samples.ndim != 2:
        valid = "(n, m) samples: `cir[None]` for one range, `i + 1j * q` for pairs"
        raise ParameterError(f"cir of shape {samples.shape}", valid=valid)
    if np.isrealobj(samples) and samples.size:
        blocks = [samples[start : start + _ROWS] for start in range(0, len(samples), _ROWS)]
        if all((block < 0).any(axis=1).all() for block in blocks):
            valid = f"complex samples: `i + 1j * q`, or {LINEAR_MAGNITUDES}"
            raise ParameterError("every row of the real cir has negative samples", valid=valid)
        if 2 * sum(np.count_nonzero(is_logarithmic(block)) for block in blocks) > len(samples):
            raise ParameterError("the cir is in dB", valid=LINEAR_MAGNITUDES)
    return samples


def _check_units(range_m: NDArray[np.float64], index: NDArray[np.float64], samples: int) -> None:
    """Raise ParameterError if most ranges are not in metres, or if all first paths are outside of the CIRs."""
    ranges, finite = range_m[np.isfinite(range_m)], index[np.isfinite(index)]
    if len(ranges) and (middle := float(np.median(ranges))) > MAX_REACH_M:
        raise ParameterError(
            f"range_m: the median is {middle:,.2f} m", valid="metres: divide millimetres by 1000"
        )
    if samples and len(finite) and ((finite < 0) | (finite >= samples)).all():
        what = f"first_path_index - start_index: {finite.min():g} to {finite.max():g} is outside of every row of the cir"
        raise ParameterError(what, valid=f"an index into the row, 0 to {samples - 1}")
