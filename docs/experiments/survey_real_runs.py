"""Estimate the anchors of the Hanyang drives with `survey_anchors`, from positions that are 1.5 m wrong in the plane.

Arguments: the folder of the drives, and the number of start values per drive. Eight of twelve surveys are within 0.10 m. These anchors are
within 5 m by 2 m, and the tag passes them on one side, so start values that are this wrong hardly determine their arrangement.
"""

import sys
from pathlib import Path

import numpy as np

from benchmarks.position_data import HEIGHTS, hanyang_run
from uwb_mitigation.calibration.survey import displacements, survey_anchors
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.config import EstimatorConfig

OFF_M = 1.5

again = int(sys.argv[2]) if len(sys.argv) > 2 else 2
for folder in sorted(Path(sys.argv[1]).glob("*_*")):
    run = hanyang_run(folder)
    anchors, ranges = run.anchors, run.ranges
    for seed in range(again):
        away = np.zeros((len(anchors), 3))
        away[:, :2] = np.random.default_rng(seed).normal(0.0, 1.0, (len(anchors), 2))
        away *= OFF_M / np.linalg.norm(away, axis=1, keepdims=True)
        guesses = anchors.moved(anchors.position + away, anchors.sd)
        before = np.sqrt((displacements(guesses.position, anchors.position)[:, :2] ** 2).sum(axis=1).mean())
        try:
            found = survey_anchors(EstimatorConfig(guesses, height=HEIGHTS["hanyang"]), ranges, off_m=OFF_M)
        except DatasetError as error:
            print(f"{folder.name:8} guess {seed}: {error}", flush=True)
            continue
        off = displacements(found.anchors.position, anchors.position)
        plan = np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())
        reported_sd_m = float(np.mean(found.anchors.sd))
        names = [(anchors.anchors[a].id, anchors.anchors[b].id) for a, b in found.swapped]
        print(
            f"{folder.name:8} guess {seed}: {before:.2f} m off in plan, found {plan:.2f} m, loss {found.loss:.2f},"
            f" reported {reported_sd_m:.2f}; swapped {names or 'none'}",
            flush=True,
        )
