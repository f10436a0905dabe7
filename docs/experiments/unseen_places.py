"""What models leave in places that they were not fitted to: docs/background/results.md, *Places it never saw*.

Arguments: the recording, and bundles.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.evaluation import zero_shot
from uwb_mitigation.evaluation.dataset import build_dataset
from uwb_mitigation.evaluation.metrics import bootstrap_interval, coverage
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.sources.opening import open_recording

with open_recording(Path(sys.argv[1])) as source:
    records = list(source)


def median_of_placements(data, rows):
    """The median over placements of the mean raw error in those of `rows`."""
    names = np.unique(data.configurations[rows])
    return np.median([data.error_m[data.configurations == name].mean() for name in names])


for path in map(Path, sys.argv[2:]):
    bundle = load_bundle(path)
    data = build_dataset(records, bundle.preprocessing)
    found = zero_shot.run(data, bundle)
    print(f"{path.name}, model {bundle.model_id:08x}, {found.passed.mean():.1%} passed through")
    is_los = data.labels == zero_shot.LOS
    offset = median_of_placements(data, is_los if is_los.any() else np.ones(len(data), bool))
    rows = {"raw": data.error_m, "raw less LOS offset": data.error_m - offset, **found.errors}
    rows["less raw LOS offset"] = found.errors["universal"] - offset
    for name, left in rows.items():
        low, high = bootstrap_interval(left, data.configurations)
        labels = np.unique(data.labels)
        told = ", ".join(f"{label} {np.abs(left[data.labels == label]).mean():.3f}" for label in labels)
        print(f"  {name:22}{np.abs(left).mean():.3f} ({low:.3f} to {high:.3f}); {told}")
    left = found.errors["universal_los_offset"]
    for label in ("", *np.unique(data.labels)):
        these = (data.labels == label) | (label == "")
        variance = found.variance_m2[these]
        narrow, wide = (coverage(left[these], variance, sigmas) for sigmas in (1.0, found.sigmas95))
        print(f"  intervals cover, {label or 'all':10}{narrow:.1%} and {wide:.1%}")
