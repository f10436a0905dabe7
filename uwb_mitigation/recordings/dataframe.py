"""A recording as a pandas DataFrame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from uwb_mitigation.types.measurement import CorrectedRange, Record

if TYPE_CHECKING:
    import pandas as pd


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
        measurement, truth = record.measurement, record.truth
        x, y, z = record.tag_position or (math.nan,) * 3
        row = {
            "stamp": measurement.stamp_ns,
            "tag_id": measurement.tag_id,
            "anchor_id": measurement.anchor_id,
            "range_m": measurement.range_m,
            "rx_power_dbm": measurement.cir.rx_power_dbm,
            "first_path_power_dbm": measurement.cir.first_path_power_dbm,
            "true_range_m": math.nan if truth is None else truth.range_m,
            "label": "" if truth is None else truth.label,
            "configuration": "" if truth is None else truth.configuration,
            "x": x,
            "y": y,
            "z": z,
        }
        if corrected is not None:
            row |= {
                "corrected_range_m": corrected.range_m,
                "variance_m2": corrected.variance_m2,
                "status": corrected.status.name,
            }
        rows.append(row)
    frame = pd.DataFrame(rows)
    if rows:
        frame["stamp"] = pd.to_datetime(frame["stamp"], utc=True)
        frame = frame.astype({"tag_id": "uint64", "anchor_id": "uint64"})
    return frame
