"""Choose how far before the reported first path a missed path may be, in simulated buildings with false peaks.

Prints for each detour the number of frames whose early peak is a missed path (within 0.5 m of the true error) or a false
peak, and the MAE in metres with the network of `universal` and with the early peak; then the MAE over all frames for
several limits. Development seed: no model was trained in these buildings, and no published figure uses them.
"""

import math
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from uwb_mitigation.mitigation import early_path
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.simulation.buildings import RADIO, WIDE_SHARE
from uwb_mitigation.simulation.channel import SPEED_OF_LIGHT_M_PER_NS
from uwb_mitigation.simulation.radio import NOISE_TAPS, TAP_NS, Receiver, Reception, place_paths
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.simulated import block_dataset

SEED, BLOCKS = 3_000_003, 60
LONGEST_TAPS = 40
LIMITS_M = (0.0, 3.0, 4.5, 6.0, 7.5, 9.0, 12.0)
FALSE_SHARES = (0.0, 0.02, 0.05)

FALSE_PEAK_M, FALSE_PEAK_DB = (5.0, 12.0), (10.0, 16.0)
"""How long before the straight-line path, and their power above the mean noise. The upper limit is the detection threshold with the
default multiplier; the strongest of 128 noise taps is 7 dB above the mean. Assumptions, see the logs of other buildings: 5 to 12 m."""


@dataclass(frozen=True)
class FalsePeaks(Receiver):
    """A receiver with a peak before the direct path that is no path in a share of the frames."""

    share: float = 0.0

    def report(self, samples, count, direct, place, above, boards, rng) -> Reception:
        lead = samples.reshape(len(samples), -1, 2)[:, NOISE_TAPS].astype(float)
        noise = (lead**2).sum(axis=2).mean(axis=1)
        early_m = rng.uniform(*FALSE_PEAK_M, len(place))
        amplitude = (
            np.sqrt(noise * 10.0 ** (rng.uniform(*FALSE_PEAK_DB, len(place)) / 10.0)) / self.pulse_peak
        )
        amplitude *= rng.random(len(place)) < self.share
        gain = amplitude * np.exp(1j * rng.uniform(0.0, 2.0 * math.pi, len(place)))
        taps = place_paths(
            (place - early_m / (SPEED_OF_LIGHT_M_PER_NS * TAP_NS))[:, None], gain[:, None], self.channel
        )
        samples = np.clip(np.rint(samples + taps.view(np.float32)), -32768, 32767).astype(np.int16)
        return super().report(samples, count, direct, place, above, boards, rng)


if __name__ == "__main__":
    early_path.SEARCH_TAPS = LONGEST_TAPS
    bundle = load_bundle(default_model_path())
    for share in FALSE_SHARES:
        radio = FalsePeaks(*(getattr(RADIO, field.name) for field in fields(RADIO)), share=share)
        blocks = [block_dataset(SEED, bundle.card.preprocessing, radio, WIDE_SHARE, n) for n in range(BLOCKS)]
        data = Dataset.joined(blocks)
        network_m = Session(bundle).predict_m(data.inputs)
        early_m = data.early_path_m
        safe = data.range_m - early_m >= early_path.MIN_RANGE_M
        print(
            f"false peaks in {share:.1%} of {len(data)} frames: detour, missed paths, false, network, early peak"
        )
        for low, high in pairwise(LIMITS_M):
            rows = (early_m > low) & (early_m <= high) & safe
            by_early = np.abs(data.error_m[rows] - early_m[rows])
            by_network = np.abs(data.error_m[rows] - network_m[rows])
            true = int((by_early < 0.5).sum())
            print(
                f"  {low:4.1f} to {high:4.1f} m {true:5} {int(rows.sum()) - true:5} "
                f"{by_network.mean() if rows.any() else np.nan:7.3f} {by_early.mean() if rows.any() else np.nan:7.3f}"
            )
        maes = []
        for limit in LIMITS_M:
            predicted = np.where(safe & (early_m <= limit), early_m, network_m)
            maes.append(f"{limit:.1f} m {np.abs(data.error_m - predicted).mean():.4f}")
        print("  MAE by limit:", ", ".join(maes))
