"""Evaluate universal models in held-out simulated buildings, by boards, type of building, and label.

Arguments: bundles. Prints the MAE in metres of raw ranges, of ranges minus the median error of the LOS ranges of all sites, and
of corrected ranges. "Usual" boards are those of the EVK1000 logs; "other" boards and sites vary more (models/universal.md).
No model was trained in these buildings.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.training.data.simulated import building_dataset
from uwb_mitigation.training.evaluation.zero_shot import correct_with_card

SEED, BLOCKS = 1_000_003, 40

if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        bundle = load_bundle(path)
        print(
            f"{path.name}, model {bundle.model_id:08x}: ranges, raw, minus constant, corrected, passed through"
        )
        for boards, wide_share in (("usual", 0.0), ("other", 1.0)):
            data = building_dataset(SEED, BLOCKS, bundle.card.preprocessing, 2, wide_share=wide_share)
            network_m = data.with_early_paths(Session(bundle).predict_m(data.inputs)).astype(np.float32)
            correction_m, _, is_passed_through = correct_with_card(data, bundle.card, network_m)
            constant_m = np.median(data.error_m[data.labels == "LOS"])
            sites = np.array([name.split("/")[1].split(" ")[0] for name in data.configurations.tolist()])
            groups = {"all": sites == sites} | {
                str(key): keys == key for keys in (sites, data.labels) for key in np.unique(keys)
            }
            for name, rows in groups.items():
                error_m = data.error_m[rows]
                residuals = (error_m, error_m - constant_m, error_m - correction_m[rows])
                text = " ".join(f"{np.abs(values).mean():7.3f}" for values in residuals)
                print(f"  {boards:6}{name:10}{rows.sum():7}{text} {is_passed_through[rows].mean():7.1%}")
