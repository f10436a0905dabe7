"""Measure the coverage of the variances of a bundle of the paper's experiment in the medium room.

Arguments: the simulated recording, and the bundle. Within one standard deviation were 68 to 74 % of the errors, and within
`interval95_sigmas` 95 to 96 %.
"""

import sys
from pathlib import Path

from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.training.evaluation.metrics import coverage
from uwb_mitigation.training.paper.data import split_by_name

bundle = load_bundle(Path(sys.argv[2]))
card = bundle.card
with open_recording(Path(sys.argv[1])) as source:
    data = build_dataset(source, card.preprocessing)
test = data.rows(split_by_name(data.configurations, "paper")[1].test)
predicted_m = Session(bundle).predict_m(test.inputs)
variance_m2 = card.variance_m2 + card.variance_per_m2 * predicted_m**2
for sigmas in (1, card.interval95_sigmas):
    print(f"{sigmas:.2f} deviations: {coverage(test.error_m - predicted_m, variance_m2, sigmas):.1%}")
