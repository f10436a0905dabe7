"""Noise of the ranges of static pairs of radios. Arguments: a recording with one placement per configuration, and bundles.

For each placement the standard deviation of the raw ranges, of ranges that are corrected one by one, and of ranges that are corrected
as in a live system, with the median of pairs at rest.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.recordings.formats import open_recording

with open_recording(Path(sys.argv[1])) as source:
    records = list(source)
measurements = [record.measurement for record in records]
names = np.array([record.truth.configuration for record in records])
raw_m = np.array([measurement.range_m for measurement in measurements])
true_m = np.array([record.truth.range_m for record in records])
is_los = np.array([record.truth.label == "LOS" for record in records])


def deviations(range_m):
    return np.array([range_m[names == name].std() for name in np.unique(names)])


raw = deviations(raw_m)
print(f"raw: median {np.median(raw):.3f} m")
for path in map(Path, sys.argv[2:]):
    for is_live in (False, True):
        mitigation = Mitigation(load_bundle(path), median_at_rest=is_live)
        range_m = np.array([corrected.range_m for corrected in mitigation.correct(measurements)])
        found, errors = deviations(range_m), range_m - true_m
        offset = np.median([errors[names == name].mean() for name in np.unique(names[is_los])])
        print(
            f"{path.stem}, {'live' if is_live else 'one by one'}: median {np.median(found):.3f} m, "
            f"{np.median(found) / np.median(raw):.2f} times raw; MAE minus LOS offset {np.abs(errors - offset).mean():.3f} m"
        )
