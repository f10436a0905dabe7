"""Measure in which buildings the correction improves positions (simulated).

Drives of a minute through the flat of the simulator, whose inner walls are of one material, or which has neither walls nor obstacles
("open"), with boards of other offsets in each drive. Prints the horizontal RMSE of the live filter in metres, mean of the
drives, and the worst ratio of corrected to raw ranges: with the offsets of the boards in the ranges, with these offsets
subtracted ("calibrated"), with odometry, and at rest at a place of each drive, where errors do not average out. The seeds are not those of `benchmarks positions`.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchmarks.position_data import simulated_run
from benchmarks.positions import WARM_UP_S, locate
from benchmarks.sites import FLATS, Drive, Standing
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.stamps import NS_PER_S

COUNTS = (4, 6, 8)
SEEDS = range(900, 906)
GROUPS = list(product(FLATS, COUNTS))
REST_SEEDS = range(900, 924)


def evaluate(building: str, anchors: int, seed: int) -> list[float]:
    """Return the RMSE of raw and of corrected ranges of a drive: as measured, calibrated, and with odometry."""
    drive = Drive(seed, seed % 4, anchors, 60.0, building)
    run = simulated_run(building, str(seed), drive)
    begin_ns = int(run.ranges.stamp_ns[0]) + round(WARM_UP_S * NS_PER_S)
    truth = run.truth.take(run.truth.stamp_ns >= begin_ns)
    calibration = Offsets(anchors={anchor: float(m) for anchor, m in enumerate(drive.offset_m, 1)})
    calibrated_m = np.maximum(run.ranges.range_m - drive.offset_m[run.ranges.anchor], 0.0)
    corrected = run.corrected()
    tracks = (
        locate(run, run.ranges),
        locate(run, corrected),
        locate(run, replace(run.ranges, range_m=calibrated_m)),
        locate(run, run.corrected(offsets=calibration)),
        locate(run, run.ranges, run.robot),
        locate(run, corrected, run.robot),
    )
    return [track_errors(track, truth).rmse for track in tracks]


def evaluate_at_rest(building: str, anchors: int, seed: int) -> list[float]:
    """Return the RMSE of raw and of corrected ranges of a robot at rest."""
    run = simulated_run(building, str(seed), Drive(seed, seed % 4, anchors, 20.0, building, Standing))
    truth = run.truth.take(run.truth.stamp_ns >= run.ranges.stamp_ns[0] + round(WARM_UP_S * NS_PER_S))
    return [track_errors(locate(run, ranges), truth).rmse for ranges in (run.ranges, run.corrected())]


def all_errors(function: Callable[[str, int, int], list[float]], seeds: range) -> NDArray[np.float64]:
    """Return the RMSE of all drives, float64 (buildings and numbers of anchors, seeds, results of the function)."""
    cases = [(*group, seed) for group in GROUPS for seed in seeds]
    with ProcessPoolExecutor() as pool:
        return np.array(list(pool.map(function, *zip(*cases, strict=True)))).reshape(
            len(GROUPS), len(seeds), -1
        )


if __name__ == "__main__":
    print("building     anchors   raw / corrected (worst)   calibrated   odometry   at rest (worst)")
    moving, resting = all_errors(evaluate, SEEDS), all_errors(evaluate_at_rest, REST_SEEDS)
    for (building, anchors), errors, at_rest in zip(GROUPS, moving, resting, strict=True):
        mean, rest = errors.mean(axis=0), at_rest.mean(axis=0)
        worst, worst_rest = ((runs[:, 1] / runs[:, 0]).max() for runs in (errors, at_rest))
        print(
            f"{building:13}{anchors:4}{mean[0]:10.3f} / {mean[1]:.3f} ({worst:.2f}){mean[2]:10.3f} / {mean[3]:.3f}"
            f"{mean[4]:10.3f} / {mean[5]:.3f}{rest[0]:10.3f} / {rest[1]:.3f} ({worst_rest:.2f})"
        )
