"""Compare a linear bias model, the universal model and their mean on few surveyed placements.

Arguments: the folder of the EVK1000 logs, and the number of draws (60).

Up to 12 placements the universal model with its own offset or the mean of both is best, from 15 on the line, by 0.01 to 0.03 m. The limit of `train` is 20,
because a linear model describes the walls of one apartment, and few placements do not show whether it generalises.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.recordings.decaranging import DecaRangingFolder
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.training.fit import candidates, linear_fit, selection
from uwb_mitigation.training.fit.candidates import Recipe, linear_bias_m
from uwb_mitigation.training.fit.options import FitOptions

data = build_dataset(DecaRangingFolder(Path(sys.argv[1])), Preprocessing())
data = data.rows(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm))
network_m = Session(load_bundle(default_model_path())).predict_m(data.inputs)
draws = int(sys.argv[2]) if len(sys.argv) > 2 else 60
for count in (6, 9, 12, 15, 18, 21):
    generator, maes = np.random.default_rng(count), []
    for _ in range(draws):
        is_train = np.isin(data.configurations, generator.permutation(data.names)[:count])
        train, test, names = data.rows(is_train), data.rows(~is_train), data.configurations[is_train]
        constant = linear_fit.fit_constant(names, train.error_m).offset_m
        own_line = linear_bias_m(candidates.fit_line(train), test)
        network = (
            network_m[~is_train]
            + linear_fit.fit_constant(names, train.error_m - network_m[is_train]).offset_m
        )
        predicted = (constant, own_line, network, (own_line + network) / 2)
        maes.append([np.abs(test.error_m - values).mean() for values in predicted])
    table = np.array(maes)
    print(count, *table.mean(axis=0).round(3), f"{np.mean(table[:, 3] < table[:, 1]):.0%}")

# The candidates of `train` without networks that are trained on the logs, with 6 folds of placements.
untrained = [item for item in candidates.new_models(Recipe(Remnet(), FitOptions())) if not item.trains]
all_candidates = candidates.with_cold_start(untrained, data, load_bundle(default_model_path()))
selected = selection.select_nested(data, all_candidates, 6, 0)
print({name: round(mae, 3) for name, mae in selected.mae().items()})
is_27 = data.configurations == "evk1000_apartment/27"
print(
    {name: round(float(np.abs(errors[~is_27]).mean()), 3) for name, errors in selected.errors.items()},
    "without 27",
)
