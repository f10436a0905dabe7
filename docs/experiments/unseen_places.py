"""Evaluate models on placements that they were not trained on, without offset and with several kinds of offsets.

Arguments: the recording, and bundles. "LOS offset" subtracts the median of all LOS placements, "left-one-out offset" the
median of all other placements. "One placement" is what a user does with one known distance: the offset is the mean error of a single
LOS placement, which is left out of the evaluation; mean and range over all choices of this placement.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.training.evaluation import zero_shot
from uwb_mitigation.training.evaluation.metrics import bootstrap_interval, coverage

with open_recording(Path(sys.argv[1])) as source:
    records = list(source)


def median_of_placements(data, rows):
    """Return the median over the placements in `rows` of their mean raw error."""
    names = np.unique(data.configurations[rows])
    return np.median([data.error_m[data.configurations == name].mean() for name in names])


def print_one_placement(name, residuals, data, is_los):
    """Print the MAE by label if the offset comes from one LOS placement: mean, and range over the choices."""
    maes = []
    for placement in np.unique(data.configurations[is_los]):
        is_test = data.configurations != placement
        errors = np.abs(residuals - residuals[~is_test].mean())
        by_label = [errors[is_test & (data.labels == label)].mean() for label in np.unique(data.labels)]
        maes.append((errors[is_test].mean(), *by_label))
    columns = zip(("all", *np.unique(data.labels)), np.array(maes).T, strict=True)
    text = ", ".join(
        f"{label} {mae.mean():.3f} ({mae.min():.3f} to {mae.max():.3f})" for label, mae in columns
    )
    print(f"  {name}, one of {len(maes)} placements: {text}")


for path in map(Path, sys.argv[2:]):
    bundle = load_bundle(path)
    data = build_dataset(records, bundle.card.preprocessing)
    found = zero_shot.evaluate_zero_shot(data, bundle)
    print(f"{path.name}, model {bundle.model_id:08x}, {found.passed_through.mean():.1%} passed through")
    is_los = data.labels == zero_shot.LOS
    offset = median_of_placements(data, is_los if is_los.any() else np.ones(len(data), bool))
    rows = {"raw": data.error_m, "raw less LOS offset": data.error_m - offset, **found.errors}
    rows["less raw LOS offset"] = found.errors["universal"] - offset
    for name, residuals in rows.items():
        low, high = bootstrap_interval(residuals, data.configurations)
        labels = np.unique(data.labels)
        by_label_text = ", ".join(
            f"{label} {np.abs(residuals[data.labels == label]).mean():.3f}" for label in labels
        )
        print(f"  {name:22}{np.abs(residuals).mean():.3f} ({low:.3f} to {high:.3f}); {by_label_text}")
    if is_los.any():
        print_one_placement("raw less offset", data.error_m, data, is_los)
        print_one_placement("universal less offset", found.errors["universal"], data, is_los)
    residuals = found.errors["universal_los_offset"]
    for label in ("", *np.unique(data.labels)):
        label_rows = (data.labels == label) | (label == "")
        errors_m, variance = residuals[label_rows], found.variance_m2[label_rows]
        coverage68 = coverage(errors_m, variance, 1.0)
        coverage95 = coverage(errors_m, variance, found.sigmas95[label_rows])
        print(f"  intervals cover, {label or 'all':10}{coverage68:.1%} and {coverage95:.1%}")
