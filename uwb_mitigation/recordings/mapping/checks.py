"""Checks of the columns of a mapped recording: rows that are dropped, clocks that start again, errors and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError, format_id
from uwb_mitigation.recordings.mapping.conversion import ColumnDict
from uwb_mitigation.recordings.mapping.mapping import LENGTHS, TIME, FieldRule
from uwb_mitigation.types.stamps import FIRST_DATE_NS, NS_PER_S

MAX_PLAUSIBLE_M, MIN_PLAUSIBLE_M = 300.0, 0.03
"""A median range outside of these limits shows a wrong unit: UWB reaches 300 m."""

MAX_INTERVAL_S, MAX_RATE_HZ = 5.0, 1000.0
"""Plausible median interval between ranges, and plausible mean rate."""

PAUSE_S = 5.0
"""Time between the parts of a recording whose clock starts again, or between placements without stamps."""

MIN_RESTART_S, MIN_PART_ROWS = 1.0, 10
"""If the stamps of a pair go back by more, its clock starts again, unless the parts are so short that rows are unsorted."""

MAX_DIFFERENCE_M = 0.1
"""Largest plausible median difference of the true ranges of an anchor and the distances of positions."""

MAX_ERROR_M = 20.0
"""Largest plausible median error of ranges."""

MAX_NEGATIVE, MAX_RATIO = 0.25, 20.0
"""Largest plausible share of negative ranges, and ratio of the median range of an anchor to that of all."""

MAX_INDEX = 1016
_LARGE_M, _LARGE_ERROR_M = 100.0, 5.0
_MAX_LISTED = 12
_PLACES = ("row", "file", "cir")
_NO_RANGE_M = (0.0, 32.767, 65.535, 327.67, 655.35)
"""Ranges that radios report without a measurement: zero, and the largest 16-bit numbers of mm and cm."""

_MAX_MISFIT = 0.08
_DAY_S = 86_400
_TIMES_S = {"minutes": 60, "hours": 3600, "days": _DAY_S}


def median(numbers: NDArray[np.float64]) -> float:
    """Return the median of the finite numbers; NaN without any."""
    finite = numbers[np.isfinite(numbers)]
    return float(np.median(finite)) if len(finite) else np.nan


# Rows that are dropped -------------------------------------------------------------------------------------------


def no_measurements(values: ColumnDict) -> dict[str, NDArray[np.bool_]]:
    """Return {reason: rows} with a number that means that there is no range."""
    rules = {}
    for number in _NO_RANGE_M:
        same = np.abs(values["range"] - number) < 1e-4
        similar = np.abs(values["range"] - number) < max(0.05, 0.2 * number)
        error = np.abs(values["true range"] - number)
        is_alone = np.array_equal(same, similar) and not (same & (error < 1.0)).any()
        bad = same if is_alone else same & (error > max(1.0, 0.2 * number))
        if bad.any():
            rules[f"range is {number:g}, which means no measurement"] = bad
    return rules


def repeated_rows(values: ColumnDict) -> tuple[int, NDArray[np.bool_]]:
    """Return the number of ranges with the stamp of another range of the pair, and which of them are equal rows.

    Rows with a coarse clock may be equal: if some of the pair's ranges with the same stamp differ, none is returned.
    """
    keys = ["stamp", "tag", "anchor"]
    # Constant columns have no strides.
    names = [name for name, column in values.items() if column.strides != (0,) and name not in _PLACES]
    frame = pd.DataFrame({name: values[name] for name in {*keys, *names}}, copy=False)
    count = int((same := frame.duplicated(keys)).sum())
    equal = frame.duplicated() if count else same
    return count, np.asarray(equal if int(equal.sum()) == count else np.zeros(len(frame), bool))


# Clocks ----------------------------------------------------------------------------------------------------------


def continue_clocks(values: ColumnDict, stamp: FieldRule, files: Sequence[Path]) -> str:
    """Continue the stamps after an overflow or a restart of the clock; `values` are in the order of the files.

    Returns:
        What happened, for the user; empty: nothing.
    """
    unwrapped = _without_overflow(values, stamp)
    if unwrapped is not None:
        values["stamp"] = unwrapped
        return "the stamps overflow or pass midnight; they were continued"
    if (boot := _boots(values)) is None:
        return ""
    stamps, end = values["stamp"].copy(), 0
    for number in range(int(boot.max()) + 1):
        rows = boot == number
        shift = end - stamps[rows].min() if number else 0
        stamps[rows] += shift
        end = stamps[rows].max() + round(PAUSE_S * NS_PER_S)
    values["stamp"] = stamps
    row = int(np.flatnonzero(boot)[0])
    where = f"row {values['row'][row] + 1} of {files[values['file'][row]].name}"
    return f"the clock starts again at {where}: {number + 1} parts, with pauses of {PAUSE_S:g} s between them"


def _without_overflow(values: ColumnDict, rule: FieldRule) -> NDArray[np.int64] | None:
    """Return the continued stamps if a 32-bit counter overflows or times without a date pass midnight; None: neither."""
    is_date = rule.unit == "iso8601" or "%" in rule.unit
    period = _DAY_S * NS_PER_S if is_date else round((TIME[rule.unit or "s"] * rule.scale) * 2**32)
    stamps, has_overflow = values["stamp"].copy(), False
    for number in range(int(values["file"].max()) + 1):
        rows = np.flatnonzero(values["file"] == number)
        periods = (stamps[rows] - round(rule.offset * NS_PER_S)) / period
        back, forward = np.diff(periods) < -0.96, np.diff(periods) > 0.96
        # Unsigned counters overflow at the period, signed ones at half of it.
        for start in (0.0, 0.5):
            before, after = periods[:-1][back] + start, periods[1:][back] + start
            if back.any() and (np.abs(before - 0.99) <= 0.01).all() and (np.abs(after - 0.01) <= 0.01).all():
                stamps[rows[1:]] += np.cumsum(back.astype(np.int64) - forward) * period
                has_overflow = True
    return stamps if has_overflow else None


def _boots(values: ColumnDict) -> NDArray[np.int64] | None:
    """Return the number of the part of each row, if a clock without a date starts again; None: it does not.

    Rows that are sorted by pairs, and files of different pairs, have one clock.
    """
    stamps = values["stamp"]
    if len(stamps) == 0 or stamps.max() >= FIRST_DATE_NS:
        return None
    frame = pd.DataFrame({name: values[name] for name in ("tag", "anchor")})
    pair = frame.groupby(["tag", "anchor"]).ngroup()
    order = np.argsort(pair.to_numpy(), kind="stable")
    limit, same = -round(MIN_RESTART_S * NS_PER_S), np.diff(pair.to_numpy()[order]) == 0
    restarts = np.zeros(len(stamps), np.int64)
    restarts[order[1:]] = (np.diff(stamps[order]) < limit) & same
    of_pair = pd.Series(restarts).groupby(pair).cumsum().to_numpy()
    count = int(of_pair.max())
    if count == 0 or len(stamps) < MIN_PART_ROWS * (count + 1):
        return None
    # A device that logs all pairs starts them again together, also pairs that it has not measured before.
    of_file: NDArray[np.int64] = np.cumsum(np.diff(stamps, prepend=stamps[:1]) < limit)
    boot = of_file if of_file[-1] == count else of_pair
    # A copy of the rows is no second part.
    is_copy = repeated_rows(values)[1]
    return None if is_copy[boot > 0].mean() > 0.9 else boot


# Errors ----------------------------------------------------------------------------------------------------------


def check_stamps(values: ColumnDict, name: str, stamp: FieldRule, *, moving: bool) -> None:
    """Raise RecordingError for equal stamps, or an implausible rate, which shows a wrong unit of stamps."""
    # Several ranges may have the same stamp.
    intervals_s = np.diff(np.sort(values["stamp"], kind="stable")) / 1e9
    intervals_s = intervals_s[intervals_s > 0]
    if not len(intervals_s) and repeated_rows(values)[0]:
        valid = "stamp: another column, or {rate_hz: ranges per second}"
        raise RecordingError("all stamps are equal", where=name, valid=valid)
    if len(intervals_s) < 10:
        return
    middle, duration_s = float(np.median(intervals_s)), float(intervals_s.sum())
    is_slow = moving and middle > MAX_INTERVAL_S
    if is_slow or len(intervals_s) / duration_s > MAX_RATE_HZ:
        what = f"the ranges are {middle:.3g} s apart, in {duration_s:.3g} s"
        valid = f"0.001 to {MAX_INTERVAL_S:g} s; probably set {_unit_of_time(middle, stamp)} of the stamps"
        valid += "; for slow recordings without motion set moving: false" if is_slow else ""
        raise RecordingError(what, where=name, valid=valid)


def _unit_of_time(interval_s: float, rule: FieldRule) -> str:
    """Return the line of a mapping that makes an interval most plausible."""
    now_ns = TIME.get(rule.unit or "s", NS_PER_S) * rule.scale
    units = {f"unit: {unit}": factor for unit, factor in TIME.items() if unit != "iso8601"}
    units |= {f"unit: s, scale: {s} ({name})": s * NS_PER_S for name, s in _TIMES_S.items()}
    misfits = {line: abs(np.log(interval_s * ns / now_ns * 10)) for line, ns in units.items() if ns != now_ns}
    return min(misfits, key=misfits.__getitem__)


def check_units(values: ColumnDict, name: str, unit: str, true_unit: str) -> None:
    """Raise RecordingError for wrong units of lengths or of the first-path index, or for differences of ranges."""
    ranges, true = np.abs(values["range"]), values["true range"]
    negative = float((values["range"] < 0).mean())
    if len(ranges) >= 20 and negative > MAX_NEGATIVE:
        valid = "ranges: differences of ranges (TDoA) are not used; if the sign is wrong, set scale: -1"
        raise RecordingError(f"{negative:.0%} of the ranges are negative", where=name, valid=valid)
    by_anchor, wrong = pd.Series(ranges).groupby(values["anchor"]), dict[int, str]()
    medians, rows_of = by_anchor.median(), by_anchor.indices
    is_plausible = medians.between(MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M)
    typical = medians[is_plausible].median()
    for anchor, middle in medians.items():
        factor = _scale(ranges[rows_of[anchor]], true[rows_of[anchor]])
        if np.isnan(factor) and not is_plausible[anchor]:
            factor = middle / typical
        fitting, misfit = _unit_of_length(factor, unit)
        # An offset may also explain the factor, but not the difference from other anchors.
        differs = middle > 2.5 * typical if factor > 1 else middle < 0.4 * typical
        if differs and fitting != (unit or "m") and (misfit < _MAX_MISFIT or not is_plausible[anchor]):
            wrong[anchor] = fitting
    if 0 < len(wrong) < len(medians):
        anchor = next(iter(wrong))
        what = f"the median range of anchor {format_id(anchor)} is {medians[anchor]:,.4g} m, others {typical:,.4g} m"
        lines = ", ".join(f"{anchor}: {fitting}" for anchor, fitting in wrong.items())
        line = f"units: {{{lines}}}" if typical < _LARGE_M else "unit: mm or cm"
        raise RecordingError(what, where=name, valid=f"probably set {line} of range")
    for column, low, high, si, alternative in (
        ("range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
        ("true range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
        ("first_path_index", 0.0, MAX_INDEX, "samples", "'10.6'"),
    ):
        middle = median(np.abs(values[column]))
        if middle > high or 0 < middle < low:
            what = f"the median {column} is {middle:,.{0 if middle > high else 4}f} {si}"
            valid = f"{low:g} to {high:g}; probably set unit: {alternative if middle > high else si}"
            raise RecordingError(what, where=name, valid=valid)
    factor = _scale(ranges, true)
    inverse = 1 / factor if factor else np.nan
    for quantity, ratio, now in (("range", factor, unit), ("truth.range", inverse, true_unit)):
        fitting, misfit = _unit_of_length(ratio, now)
        if misfit < _MAX_MISFIT and fitting != (now or "m"):
            what = f"the ranges are {factor:.3g} times the true ranges"
            valid = f"the same unit: probably set unit: {fitting} of {quantity}"
            raise RecordingError(what, where=name, valid=valid)


def _unit_of_length(factor: float, unit: str) -> tuple[str, float]:
    """Return the unit that explains a factor of lengths in `unit` best, and the logarithm of the rest of the factor."""
    now_m = LENGTHS[unit or "m"]
    ratio = factor / now_m if factor > 0 else np.inf
    misfits = {name: float(abs(np.log(ratio * m))) for name, m in LENGTHS.items()}
    return min(misfits.items(), key=lambda item: item[1])


def _scale(ranges_m: NDArray[np.float64], true_m: NDArray[np.float64]) -> float:
    """Return the factor between ranges and true ranges, estimated without their offset; NaN: unknown."""
    finite = np.isfinite(ranges_m) & np.isfinite(true_m)
    x, y = true_m[finite], ranges_m[finite]
    if len(x) < 10 or np.median(x) <= 0:
        return np.nan
    upper = x > np.median(x)
    ratio = float(np.median(y) / np.median(x))
    if not upper.any() or (spread := float(np.median(x[upper]) - np.median(x[~upper]))) < 0.2 * np.median(x):
        return ratio
    slope = float(np.median(y[upper]) - np.median(y[~upper])) / spread
    # A constant offset changes only the ratio.
    return slope if abs(slope / ratio - 1) < 0.15 else np.nan


# Warnings --------------------------------------------------------------------------------------------------------


def anchor_warnings(
    values: ColumnDict, positions: Mapping[int, NDArray[np.float64]], differences_m: NDArray[np.float64]
) -> Iterator[str]:
    """Yield warnings about the positions of anchors.

    Args:
        values: the ranges.
        positions: {anchor: position}.
        differences_m: distances of positions minus true ranges, (n,); NaN: unknown.
    """
    if not positions:
        return
    ranged = np.unique(values["anchor"]).tolist()
    differences = {anchor: median(np.abs(differences_m[values["anchor"] == anchor])) for anchor in ranged}
    if wrong := [f"{format_id(a)} by {d:.2f} m" for a, d in differences.items() if d > MAX_DIFFERENCE_M]:
        what = f"true ranges and distances from positions differ for anchor {_listed(wrong)}"
        yield f"{what}: wrong anchor positions or ids, lever arm or frame?"
    if missing := [format_id(anchor) for anchor in ranged if anchor not in positions]:
        swapped = set(np.unique(values["tag"]).tolist()) & set(positions)
        hint = "are tag and anchor exchanged?" if swapped else "compare the ids"
        yield f"{len(missing)} of {len(ranged)} anchors have no position: {_listed(missing)}: {hint}"
    if unused := [format_id(anchor) for anchor in positions if anchor not in ranged]:
        yield f"{len(unused)} anchors have a position but no range: {_listed(unused)}"


def _listed(texts: list[str]) -> str:
    more = len(texts) - _MAX_LISTED
    return ", ".join(texts[:_MAX_LISTED]) + (f" and {more} more" if more > 0 else "")


def value_warnings(values: ColumnDict, *, errors_measured: bool) -> Iterator[str]:
    """Yield warnings of implausible values; `errors_measured`: the recording has errors, but no true ranges."""
    ranges, errors = values["range"], values["range"] - values["true range"]
    errors = errors[np.isfinite(errors)]
    for name, numbers, limit in (("ranges", ranges, _LARGE_M), ("errors", np.abs(errors), _LARGE_ERROR_M)):
        limit = max(limit, 5 * median(numbers))
        if count := int(np.count_nonzero(numbers > limit)):
            yield f"{count} {name} are above {limit:.0f} m"
    medians = pd.Series(ranges).groupby(values["anchor"]).median()
    for anchor, ratio in (medians / medians.median())[lambda ratios: ratios > MAX_RATIO].items():
        what = f"the median range of anchor {format_id(anchor)} is {ratio:.0f} times that of the others"
        yield f"{what}: if its unit differs, set units: {{{anchor}: cm}} of range"
    if (middle := median(np.abs(errors))) > MAX_ERROR_M:
        yield f"the median error is {middle:.0f} m: do range and truth have the same unit?"
    # Errors of UWB have a tail of late first paths, which are positive.
    low, middle, high = np.percentile(errors, (5, 50, 95)) if len(errors) >= 20 else (0.0, 0.0, 0.0)
    if errors_measured and middle - low > 2 * max(high - middle, 0.0) and low < -0.3 and middle < 0:
        what = f"most errors are negative (median {middle:.2f} m, 5 % below {low:.2f} m)"
        hint = "probably the error column is true - measured (set scale: -1)"
        yield f"{what}: {hint}, if not many ranges are too short; estimated from the distribution"
    if negative := int(np.count_nonzero(ranges < 0)):
        yield f"{negative} ranges are negative"
    level = median(values["rx_power"])
    if np.isfinite(level) and not -140 < level < -20:
        yield f"the median receive level is {level:.0f}, which is not in dBm"
