"""Compare the errors of shipped models with their standard deviations on the channels of a DW1000 (simulated).

The held-out buildings of the simulator on each channel; on 4 and 7 also with a pulse that is the inverse of the bandwidth. Prints MAE in
metres raw and corrected, and the factor of the standard deviations that makes the corrected errors most likely (Laplace), for all ranges
with the shares of the conditions in drives and for each condition.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.simulation.buildings import RADIO
from uwb_mitigation.simulation.channel import CHANNELS, Channel
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.simulated import block_dataset
from uwb_mitigation.training.evaluation.zero_shot import correct_with_card
from uwb_mitigation.training.universal import CONDITION_SHARES

SEED, BLOCKS, WIDE_SHARE = 1_000_003, 40, 0.5
SHORT_PULSES = [replace(CHANNELS[number], pulse_taps=1.33) for number in (4, 7)]


def evaluate(path: Path, channel: Channel) -> str:
    """Return the row of a channel."""
    bundle = load_bundle(path)
    simulate = partial(
        block_dataset, SEED, bundle.card.preprocessing, replace(RADIO, channel=channel), WIDE_SHARE
    )
    data = Dataset.joined(list(map(simulate, range(BLOCKS))))
    network_m = data.with_early_paths(Session(bundle).predict_m(data.inputs)).astype(np.float32)
    correction_m, variance_m2, is_passed_through = correct_with_card(data, bundle.card, network_m)
    rows = ~is_passed_through
    error_m = np.abs(data.error_m - correction_m)
    ratio = np.sqrt(2.0) * error_m / np.sqrt(variance_m2)
    means = [float(ratio[rows & (data.labels == label)].mean()) for label in CONDITION_SHARES]
    factor = np.average(means, weights=list(CONDITION_SHARES.values()))
    mae_m = np.abs(data.error_m).mean(), error_m.mean()
    values = " ".join(f"{value:6.2f}" for value in (factor, *means))
    return (
        f"{path.stem:20} {channel.number:7} {channel.pulse_taps:6.2f} {mae_m[0]:6.3f} {mae_m[1]:6.3f}   "
        f"{values} {1.0 - rows.mean():8.1%}"
    )


if __name__ == "__main__":
    print("model                channel  pulse    raw  corr.   factor    LOS   NLOS    NDP   passed through")
    cases = product(map(Path, sys.argv[1:]), (*CHANNELS.values(), *SHORT_PULSES))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for row in pool.map(evaluate, *zip(*cases, strict=True)):
            print(row, flush=True)
