"""Position and heading on a real recording with odometry: the Labyrinth data set of TU Chemnitz (not part of the repository).

30 s of a small robot with wheel odometry among four anchors, 233 ranges (https://github.com/TUC-ProAut/libRSF,
CC BY-SA 4.0). The height is unknown; all heights are set to 0. No constant was tuned on these data. The reference of the
heading is the direction of the differences between true positions, where the speed is above 0.1 m/s. Positions count from 5 s
on, as long as the heading takes to be found.

    python docs/experiments/odometry_real_run.py $UWB_MITIGATION_DATA/chemnitz_labyrinth
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.robot_estimator import make_estimator
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, RobotData
from uwb_mitigation.positioning.track_errors import TrackErrors, track_errors
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.tracks import Odometry, Ranges, Track, TruePath

HALF_TRACK_M = 0.0785
"""Half the distance of the wheels. The columns "right" and "left" are exchanged (README of the data)."""

MOVING, FROM_S = 0.1, 5.0


def load(folder: Path) -> tuple[AnchorMap, Ranges, Odometry, TruePath]:
    """Return anchors, ranges, odometry and the true path; its yaw is NaN where the robot does not move."""
    lines = [line.split() for line in (folder / "Indoor_UWB_Input.txt").read_text().splitlines()]
    measured, wheels = (
        np.array([line[1:] for line in lines if line[0] == kind], np.float64)
        for kind in ("range2", "odom2diff")
    )
    ids, first, row = np.unique(measured[:, 5], return_index=True, return_inverse=True)
    anchors = AnchorMap(
        [Anchor(int(i), (*measured[k, 3:5].tolist(), 0.0)) for i, k in zip(ids, first, strict=True)]
    )
    ranges = Ranges(
        _nanoseconds(measured[:, 0]), row, measured[:, 1], measured[:, 2], np.full(len(measured), np.nan), 1
    )
    right, left, lateral = wheels[:, 1:4].T
    twist = np.stack([(right + left) / 2.0, lateral, (left - right) / (2.0 * HALF_TRACK_M)], axis=1)
    of_right, of_left, of_lateral = wheels[:, 5:8].T
    spread = of_right + of_left
    variances = np.stack([spread / 4.0, of_lateral, spread / (2.0 * HALF_TRACK_M) ** 2], axis=1)
    n = len(twist)
    odometry = Odometry(
        _nanoseconds(wheels[:, 0]),
        np.full((n, 3), np.nan),
        np.zeros((n, 3, 3)),
        twist,
        variances[:, :, None] * np.eye(3),
    )
    true = np.array(
        [line.split()[1:4] for line in (folder / "Indoor_UWB_GT.txt").read_text().splitlines()], np.float64
    )
    velocity = np.gradient(true[:, 1:], true[:, 0], axis=0)
    yaw = np.where(np.hypot(*velocity.T) > MOVING, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)
    position = np.column_stack([true[:, 1:], np.zeros(len(true))])
    return anchors, ranges, odometry, TruePath(_nanoseconds(true[:, 0]), position, yaw)


def evaluate(folder: Path, *, with_odometry: bool) -> tuple[Track, TrackErrors]:
    """Return the live track, and its errors from `FROM_S` on."""
    anchors, ranges, odometry, truth = load(folder)
    robot = RobotData(odometry) if with_odometry else None
    config = EstimatorConfig(anchors, NoiseModel(), Height(0.0, 0.1), robot=robot)
    track = make_estimator(config).run(ranges)
    begin_ns = int(truth.stamp_ns[0]) + round(FROM_S * 1e9)
    return track, track_errors(track.take(track.stamp_ns > begin_ns), truth)


def _nanoseconds(time_s: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.asarray(np.rint(time_s * 1e9), np.int64)


def main() -> None:
    folder = Path(sys.argv[1])
    for name, with_odometry in (("ranges only", False), ("with odometry", True)):
        _, errors = evaluate(folder, with_odometry=with_odometry)
        print(
            f"{name}: RMSE {errors.rmse:.3f} m, in 95 % ellipse {errors.coverage95:.0%}, "
            f"NEES {errors.nees_per_dof:.2f}, heading RMSE {errors.heading_rmse_deg:.1f} degrees"
        )


if __name__ == "__main__":
    main()
