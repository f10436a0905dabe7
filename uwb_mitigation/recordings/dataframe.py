"""A recording as a pandas DataFrame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from uwb_mitigation.types.measurement import CorrectedRange, Record, Truth

if TYPE_CHECKING:
    import pandas as pd

_UNKNOWN = Truth(math.nan)


def to_dataframe(records: Iterable[Record | tuple[Record, CorrectedRange]]) -> pd.DataFrame:
    """Return the ranges of a recording as a data frame, without their CIRs.

    Args:
        records: an open recording, or the pairs of `Mitigation.correct_records`.

    Returns:
        One row per range: `stamp` (UTC), `tag_id`, `anchor_id` (uint64), `range_m`, `rx_power_dbm`, `first_path_power_dbm`,
        `true_range_m`, `label`, `configuration`, and the true position of the tag `x`, `y`, `z` in m. Pairs also have
        `corrected_range_m`, `variance_m2` and `status` (text). NaN and empty text: unknown.

    Raises:
        RecordingError: from `records`.
        ImportError: pandas is not installed.
    """
    import pandas as pd

    rows = []
    for item in records:
        record, corrected = item if isinstance(item, tuple) else (item, None)
        measured, truth = record.measurement, record.truth or _UNKNOWN
        row = {name: getattr(measured, name) for name in ("stamp_ns", "tag_id", "anchor_id", "range_m")}
        row |= {name: getattr(measured.cir, name) for name in ("rx_power_dbm", "first_path_power_dbm")}
        row |= {"true_range_m": truth.range_m, "label": truth.label, "configuration": truth.configuration}
        row |= dict(zip("xyz", record.tag_position or (math.nan,) * 3, strict=True))
        if corrected is not None:
            row |= {"corrected_range_m": corrected.range_m, "variance_m2": corrected.variance_m2}
            row["status"] = corrected.status.name
        rows.append(row)
    frame = pd.DataFrame(rows).rename(columns={"stamp_ns": "stamp"})
    if rows:
        frame["stamp"] = pd.to_datetime(frame["stamp"], utc=True)
        frame = frame.astype({"tag_id": "uint64", "anchor_id": "uint64"})
    return frame
