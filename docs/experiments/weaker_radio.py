"""Evaluate models with a radio that receives less or more power than the training data.

Arguments: the folder of the EVK1000 logs, the step between the ranges that are used, and bundles or names of shipped ones. For a model
without the offset of boards, the offset of the LOS placements is subtracted first.

`universal` has at most 0.86 times the error of raw ranges minus offset (at -17 dB). `evk1000_apartment` is 10 to 11 % worse at -13 dB: a
single range cannot show whether the radio is weaker or a wall is in between.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.shipped import model_path
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.training.evaluation.accuracy import evaluate_accuracy

with open_recording(Path(sys.argv[1])) as source:
    records = list(source)[:: int(sys.argv[2])]
errors = {}
for record in records:
    if record.truth.label == "LOS":
        error = record.measurement.range_m - record.truth.range_m
        errors.setdefault(record.truth.configuration, []).append(error)
offset_m = np.median([np.mean(values) for values in errors.values()])


def with_level(record, level, subtracted_m):
    """Return the record of a radio that receives `level` dB more, with an offset subtracted from its range."""
    cir = record.measurement.cir
    powers = {
        "rx_power_dbm": cir.rx_power_dbm + level,
        "first_path_power_dbm": cir.first_path_power_dbm + level,
    }
    changed_cir = replace(cir, scale=10 ** (level / 20), **powers)
    range_m = record.measurement.range_m - subtracted_m
    return replace(record, measurement=replace(record.measurement, cir=changed_cir, range_m=range_m))


for name in sys.argv[3:]:
    mitigation = Mitigation(load_bundle(model_path(name)))
    subtracted_m = offset_m if mitigation.bundle.card.linear_bias == LinearBiasModel(0.0) else 0.0
    print(name)
    for level in (-25, *range(-20, -8), -7, -5, 0, 3, 5, 8, 10, 15, 20):
        found = evaluate_accuracy(mitigation, (with_level(record, level, subtracted_m) for record in records))
        print(f"{level:5} {found.corrected.mae / found.raw.mae:.3f}", found.statuses)
