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

from uwb_mitigation.evaluation import baselines, splits
from uwb_mitigation.evaluation.dataset import build_dataset
from uwb_mitigation.evaluation.linear_fit import least_absolute_deviations
from uwb_mitigation.preprocessing import Preprocessing
from uwb_mitigation.sources.decaranging import CirFrame, DecaRangingFolder


def features(data):
    """Return candidate columns in addition to 1 and RSL. Energies are in dB, from magnitudes, which are squared inputs."""
    energy, of_cir = data.inputs.astype(float) ** 4, baselines.features(data, header=False)
    level = [
        10 * np.log10(energy[:, taps].sum(1) + 1e-12)
        for taps in (slice(0, 5), slice(5, 15), slice(6, 9), slice(None))
    ]
    gap = data.rx_power_dbm - data.first_path_power_dbm
    beside = {
        "log of the range": np.log(data.range_m.clip(0.1)),
        "mean delay": of_cir[:, 5],
        "delay spread": of_cir[:, 6],
        "kurtosis": of_cir[:, 7],
        "noise threshold": np.log(data.headers[:, 1]),
    }
    return {
        "gap": [gap],
        "early": [level[1] - level[3]],
        "early, gap": [level[1] - level[3], gap],
        "before the first path": [level[0]],
        "first path": [level[2]],
        **{f"gap, {name}": [gap, column] for name, column in beside.items()},
    }


def predicted(data, columns, train, test):
    """Fit a line to the means of the configurations in `train`, and predict the ranges in `test`."""
    design = np.column_stack([np.ones(len(data)), data.rx_power_dbm, *columns]).astype(float)
    parts = [train[data.configurations[train] == name] for name in np.unique(data.configurations[train])]
    means = [np.array([values[part].mean(axis=0) for part in parts]) for values in (design, data.error_m)]
    return design[test] @ least_absolute_deviations(*means)


def inner_error(data, columns, train):
    left = []
    for seed in range(3):
        for split in splits.by_configuration(data.configurations[train], 5, seed):
            fitted, held_out = train[split.train], train[split.test]
            left.append(np.abs(data.error_m[held_out] - predicted(data, columns, fitted, held_out)).sum())
    return sum(left)


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
known = np.isfinite([data.rx_power_dbm - data.first_path_power_dbm for data in (final, poll)]).all(axis=0)
final, poll = final.rows(known), poll.rows(known)
beside, error, names = features(final), final.error_m, final.configurations
splits_by_configuration = int(sys.argv[2]) if len(sys.argv) > 2 else 10
for group, seeds in (("configuration", splits_by_configuration), ("tag", 1), ("half", 1)):
    maes, chosen = [], []
    for seed in range(seeds):
        left = {}
        for split in splits.by_group(final, splits.Group(group), 6, seed):
            train, test = split.train, split.test
            found = {name: predicted(final, columns, train, test) for name, columns in beside.items()}
            best = min(("gap", "early"), key=lambda name: inner_error(final, beside[name], train))
            chosen.append(best)
            found["gap or early, chosen"] = found[best]
            found["poll"] = predicted(poll, features(poll)["gap"], train, test)
            found["mean of poll and final"] = (found["gap"] + found["poll"]) / 2
            found["last ten predictions"] = last_ten(found["gap"], names[test])
            found["last ten corrected ranges"] = error[test] - last_ten(
                error[test] - found["gap"], names[test]
            )
            for name, values in found.items():
                left.setdefault(name, []).append(np.abs(error[test] - values))
        maes.append([np.concatenate(values).mean() for values in left.values()])
    print(group, f"early energy in {chosen.count('early')} of {len(chosen)} choices")
    for name, mae in zip(left, np.mean(maes, axis=0), strict=True):
        print(f"  {name:28} {mae:.3f}")
