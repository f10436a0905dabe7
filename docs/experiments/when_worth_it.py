"""Measure in which buildings the correction improves positions (simulated).

Drives of a minute through the flat of the simulator, whose inner walls are of one material, or which has neither walls nor obstacles
("open"), with boards of other offsets in each drive. Prints the horizontal RMSE of the live filter in metres, mean of the
drives, and the worst ratio of corrected to raw ranges: with the offsets of the boards in the ranges, with these offsets
subtracted ("calibrated"), and with odometry. The seeds are not those of `benchmarks positions`.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np

from benchmarks.position_data import simulated_run
from benchmarks.positions import WARM_UP_S, locate
from benchmarks.sites import FLATS, Drive
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.stamps import NS_PER_S

COUNTS = (4, 6, 8)
SEEDS = range(900, 906)


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


if __name__ == "__main__":
    print(
        "building     anchors   raw / corrected (worst)   calibrated: raw / corrected   odometry: raw / corrected"
    )
    groups = list(product(FLATS, COUNTS))
    with ProcessPoolExecutor() as pool:
        results = pool.map(
            evaluate, *zip(*((*group, seed) for group in groups for seed in SEEDS), strict=True)
        )
        errors = np.array(list(results)).reshape(len(groups), len(SEEDS), -1)
    for (building, anchors), of_group in zip(groups, errors, strict=True):
        mean, worst = of_group.mean(axis=0), (of_group[:, 1] / of_group[:, 0]).max()
        print(
            f"{building:13}{anchors:4}{mean[0]:12.3f} / {mean[1]:.3f} ({worst:.2f}){mean[2]:16.3f} / {mean[3]:.3f}"
            f"{mean[4]:19.3f} / {mean[5]:.3f}"
        )
