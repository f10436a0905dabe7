"""Compare features for the linear bias model in addition to the received power, on the EVK1000 logs.

Arguments: the folder of the logs, and the number of splits by configuration (10).

The energy before the first path is the only feature of the CIR that might generalise: 13 % better by tag location, but 3 % worse
between the halves of the flat. It does not ship, because it gains less than 5 % by configuration and depends on the position
of the window. The first-path level contains the same information as the power gap. Averages over the last ten exchanges gain
0.007 m, which is noise that a filter removes, too.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.recordings.decaranging import CirFrame, DecaRangingFolder
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.training.evaluation import baselines
from uwb_mitigation.training.fit.linear_fit import least_absolute_deviations


def features(data):
    """Return candidate columns in addition to 1 and RSL. Energies are in dB, from magnitudes, which are squared inputs."""
    energy, cir_features = data.inputs.astype(float) ** 4, baselines.features(data, header=False)
    level = [
        10 * np.log10(energy[:, taps].sum(1) + 1e-12)
        for taps in (slice(0, 5), slice(5, 15), slice(6, 9), slice(None))
    ]
    gap = data.rx_power_dbm - data.first_path_power_dbm
    candidate_columns = {
        "log of the range": np.log(data.range_m.clip(0.1)),
        "mean delay": cir_features[:, 5],
        "delay spread": cir_features[:, 6],
        "kurtosis": cir_features[:, 7],
        "noise threshold": np.log(data.headers[:, 1]),
    }
    return {
        "gap": [gap],
        "early": [level[1] - level[3]],
        "early, gap": [level[1] - level[3], gap],
        "before the first path": [level[0]],
        "first path": [level[2]],
        **{f"gap, {name}": [gap, column] for name, column in candidate_columns.items()},
    }


def predicted(data, columns, train, test):
    """Fit a line to the means of the configurations in `train`, and predict the ranges in `test`."""
    design = np.column_stack([np.ones(len(data)), data.rx_power_dbm, *columns]).astype(float)
    parts = [train[data.configurations[train] == name] for name in np.unique(data.configurations[train])]
    means = [np.array([values[part].mean(axis=0) for part in parts]) for values in (design, data.error_m)]
    return design[test] @ least_absolute_deviations(*means)


def inner_error(data, columns, train):
    errors = []
    for seed in range(3):
        for split in splits.by_configuration(data.configurations[train], 5, seed):
            train_rows, held_out = train[split.train], train[split.test]
            errors.append(
                np.abs(data.error_m[held_out] - predicted(data, columns, train_rows, held_out)).sum()
            )
    return sum(errors)


def last_ten(values, names):
    return np.array(
        [
            values[max(0, i - 9) : i + 1][names[max(0, i - 9) : i + 1] == names[i]].mean()
            for i in range(len(values))
        ]
    )


final, poll = (
    build_dataset(DecaRangingFolder(Path(sys.argv[1]), cir=cir), Preprocessing())
    for cir in (CirFrame.FINAL, CirFrame.POLL)
)
has_powers = np.isfinite([data.rx_power_dbm - data.first_path_power_dbm for data in (final, poll)]).all(
    axis=0
)
final, poll = final.rows(has_powers), poll.rows(has_powers)
candidate_columns, error, names = features(final), final.error_m, final.configurations
splits_by_configuration = int(sys.argv[2]) if len(sys.argv) > 2 else 10
for group, seeds in (("configuration", splits_by_configuration), ("tag", 1), ("half", 1)):
    maes, selected = [], []
    for seed in range(seeds):
        errors_by_name = {}
        for split in splits.by_group(final, splits.GroupKey(group), 6, seed):
            train, test = split.train, split.test
            found = {
                name: predicted(final, columns, train, test) for name, columns in candidate_columns.items()
            }
            best = min(("gap", "early"), key=lambda name: inner_error(final, candidate_columns[name], train))
            selected.append(best)
            found["gap or early, chosen"] = found[best]
            found["poll"] = predicted(poll, features(poll)["gap"], train, test)
            found["mean of poll and final"] = (found["gap"] + found["poll"]) / 2
            found["last ten predictions"] = last_ten(found["gap"], names[test])
            found["last ten corrected ranges"] = error[test] - last_ten(
                error[test] - found["gap"], names[test]
            )
            for name, values in found.items():
                errors_by_name.setdefault(name, []).append(np.abs(error[test] - values))
        maes.append([np.concatenate(values).mean() for values in errors_by_name.values()])
    print(group, f"early energy in {selected.count('early')} of {len(selected)} choices")
    for name, mae in zip(errors_by_name, np.mean(maes, axis=0), strict=True):
        print(f"  {name:28} {mae:.3f}")
