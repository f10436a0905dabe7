"""Compare the errors of shipped models with their standard deviations on the channels of a DW1000 (simulated).

The held-out buildings of the simulator, with centre frequency and bandwidth of each channel: they change free-space loss, loss of
walls, diffraction, transmit power and pulse. Prints MAE in metres raw and corrected, and the factor of the standard deviations that makes the
corrected errors most likely (Laplace), for all ranges with the shares of the conditions in drives and for each condition.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from math import log10
from multiprocessing import get_context
from pathlib import Path

import numpy as np

SEED, BLOCKS, WIDE_SHARE = 1_000_003, 40, 0.5
USUAL_HZ, WIDE_HZ = 499.2e6, 900e6
"""Bandwidths. The receiver limits those of channels 4 and 7 to 900 MHz (DW1000 user manual, section 10.5)."""

CHANNELS = (
    (1, 3494.4e6, USUAL_HZ, 2.4),
    (2, 3993.6e6, USUAL_HZ, 2.4),
    (3, 4492.8e6, USUAL_HZ, 2.4),
    (5, 6489.6e6, USUAL_HZ, 2.4),
    *((number, hz, WIDE_HZ, taps) for number, hz in ((4, 3993.6e6), (7, 6489.6e6)) for taps in (1.8, 1.33)),
)
"""Number, centre frequency, bandwidth, and full width of the pulse at half amplitude, taps. 1.33 taps are the inverse of 900 MHz; the
samples resolve them badly."""


def evaluate(path: Path, number: int, frequency_hz: float, bandwidth_hz: float, pulse_taps: float) -> str:
    """Return the row of a channel. The process must not have imported the simulator before."""
    from uwb_mitigation.simulation import channel

    channel.FREE_SPACE_LOSS_1M_DB += 20.0 * log10(frequency_hz / channel.CENTRE_FREQUENCY_HZ)
    channel.WAVELENGTH_M *= channel.CENTRE_FREQUENCY_HZ / frequency_hz
    channel.CENTRE_FREQUENCY_HZ = frequency_hz
    from uwb_mitigation.simulation import radio

    radio.PULSE_WIDTH_TAPS = pulse_taps
    radio.PULSE_PEAK = float(radio.pulse(np.zeros(1))[0])
    phases = np.arange(radio._PHASES)[:, None] / radio._PHASES
    radio._PULSE_TABLE = radio.pulse(radio._OFFSETS[None, :] - phases)
    radio.EDGE_LEAD_TAPS = radio._half_amplitude_lead()
    from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
    from uwb_mitigation.simulation.buildings import RADIO
    from uwb_mitigation.training.data.dataset import Dataset
    from uwb_mitigation.training.data.simulated import block_dataset
    from uwb_mitigation.training.evaluation.zero_shot import correct_with_card
    from uwb_mitigation.training.universal import CONDITION_SHARES

    bundle = load_bundle(path)
    # Regulations limit the power per MHz.
    sender = replace(RADIO, tx_power_dbm=RADIO.tx_power_dbm + 10.0 * log10(bandwidth_hz / USUAL_HZ))
    simulate = partial(block_dataset, SEED, bundle.preprocessing, sender, WIDE_SHARE)
    data = Dataset.joined(list(map(simulate, range(BLOCKS))))
    network_m = data.with_early_paths(Session(bundle).predict_m(data.inputs)).astype(np.float32)
    corrections = correct_with_card(data, bundle.card, network_m)
    rows = ~corrections.passed_through
    error_m = np.abs(data.error_m - corrections.correction_m)
    ratio = np.sqrt(2.0) * error_m / np.sqrt(corrections.variance_m2)
    means = [float(ratio[rows & (data.labels == label)].mean()) for label in CONDITION_SHARES]
    factor = np.average(means, weights=list(CONDITION_SHARES.values()))
    mae_m = np.abs(data.error_m).mean(), error_m.mean()
    values = " ".join(f"{value:6.2f}" for value in (factor, *means))
    return f"{number:7} {pulse_taps:6.2f} {mae_m[0]:6.3f} {mae_m[1]:6.3f}   {values} {1.0 - rows.mean():8.1%}"


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        print(f"{path.name}\nchannel  pulse    raw  corr.   factor    LOS   NLOS    NDP   passed through")
        for row in CHANNELS:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                print(pool.submit(evaluate, path, *row).result(), flush=True)
