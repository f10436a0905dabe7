"""Checks of the values of a mapped recording: units, rates, and positions of anchors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError, format_id
from uwb_mitigation.recordings.mapping.conversion import ColumnDict
from uwb_mitigation.recordings.mapping.mapping import LENGTHS

MAX_PLAUSIBLE_M, MIN_PLAUSIBLE_M = 300.0, 0.03
"""A median range outside of these limits shows a wrong unit: UWB reaches 300 m."""

MAX_INTERVAL_S, MAX_RATE_HZ = 5.0, 1000.0
"""Plausible median interval between ranges, and plausible mean rate."""

MAX_DIFFERENCE_M = 0.1
"""Largest plausible median difference of the true ranges of an anchor and the distances of positions."""

MAX_ERROR_M = 20.0
"""Largest plausible median error of ranges."""

MAX_INDEX = 1016
_MAX_LISTED = 12


def median(numbers: NDArray[np.float64]) -> float:
    """Return the median of the finite numbers; NaN without any."""
    finite = numbers[np.isfinite(numbers)]
    return float(np.median(finite)) if len(finite) else np.nan


def pair_intervals_s(values: ColumnDict) -> NDArray[np.float64]:
    """Return the times between successive ranges of the same pair, s."""
    order = np.lexsort((values["stamp"], values["anchor"], values["tag"]))
    tag, anchor, stamp = (values[name][order] for name in ("tag", "anchor", "stamp"))
    same = (tag[1:] == tag[:-1]) & (anchor[1:] == anchor[:-1])
    intervals: NDArray[np.float64] = np.diff(stamp)[same] / 1e9
    return intervals


def check_units(values: ColumnDict, name: str) -> None:
    """Raise RecordingError for wrong units of lengths or of the first-path index."""
    for column, low, high, unit, alternative in (
        ("range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
        ("true range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
        ("first_path_index", 0.0, MAX_INDEX, "samples", "'10.6'"),
    ):
        middle = median(np.abs(values[column]))
        if middle > high or 0 < middle < low:
            raise RecordingError(
                f"the median {column} is {middle:,.{0 if middle > high else 4}f} {unit}",
                where=name,
                valid=f"{low:g} to {high:g}; probably set unit: {alternative if middle > high else unit}",
            )
    factor = _scale(values["range"], values["true range"])
    for unit, metres in LENGTHS.items():
        for ratio, quantity in ((1 / metres, "range"), (metres, "truth.range")):
            if unit != "m" and abs(factor / ratio - 1) < 0.08:
                raise RecordingError(
                    f"the ranges are {factor:.3g} times the true ranges", where=name,
                    valid=f"the same unit: probably set unit: {unit} of {quantity}",
                )  # fmt: skip


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


def check_rate(values: ColumnDict, name: str, *, moving: bool) -> None:
    """Raise RecordingError for an implausible rate, which shows a wrong unit of stamps."""
    # Several ranges may have the same stamp.
    intervals_s = np.diff(np.unique(values["stamp"])) / 1e9
    if len(intervals_s) < 10:
        return
    middle, rate_hz = float(np.median(intervals_s)), len(intervals_s) / float(intervals_s.sum())
    if moving and middle > MAX_INTERVAL_S:
        hint = "probably set unit: ms of the stamps; for slow recordings without motion set moving: false"
    elif rate_hz > MAX_RATE_HZ:
        hint = "probably set unit: s of the stamps"
    else:
        return
    what = f"the ranges are {middle:.3g} s apart, in {intervals_s.sum():.3g} s"
    raise RecordingError(what, where=name, valid=f"{1 / MAX_RATE_HZ:g} to {MAX_INTERVAL_S:g} s; {hint}")


def anchor_warnings(
    values: ColumnDict, positions: Mapping[int, NDArray[np.float64]], differences_m: NDArray[np.float64]
) -> Iterator[str]:
    """Yield warnings about the positions of anchors.

    Args:
        values: the ranges.
        positions: {anchor: position}.
        differences_m: distances of positions minus true ranges, (n,); NaN: unknown.
    """
    ranged = np.unique(values["anchor"]).tolist()
    if not positions:
        return
    wrong = []
    for anchor in ranged:
        difference = median(np.abs(differences_m[values["anchor"] == anchor]))
        if difference > MAX_DIFFERENCE_M:
            wrong.append(f"{format_id(anchor)} by {difference:.2f} m")
    if wrong:
        yield (
            f"true ranges and distances from positions differ for anchor {_listed(wrong)}: "
            "wrong anchor positions or ids, lever arm or frame?"
        )
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
    if repeated := int(np.count_nonzero(pair_intervals_s(values) == 0)):
        yield f"{repeated} ranges repeat the stamp of another range of the same pair"
    errors = values["range"] - values["true range"]
    errors = errors[np.isfinite(errors)]
    if (middle := median(np.abs(errors))) > MAX_ERROR_M:
        yield f"the median error is {middle:.0f} m: do range and truth have the same unit?"
    if errors_measured and len(errors) >= 20:
        # Errors of UWB have a tail of late first paths, which are positive.
        low, middle, high = np.percentile(errors, (5, 50, 95))
        if middle - low > 2 * max(high - middle, 0.0) and low < -0.3 and middle < 0:
            yield (
                f"most errors are negative (median {middle:.2f} m, 5 % below {low:.2f} m): probably the error column is "
                "true - measured (set scale: -1), if not many ranges are too short; estimated from the distribution"
            )
    if negative := int(np.count_nonzero(values["range"] < 0)):
        yield f"{negative} ranges are negative"
    level = median(values["rx_power"])
    if np.isfinite(level) and not -140 < level < -20:
        yield f"the median receive level is {level:.0f}, which is not in dBm"
