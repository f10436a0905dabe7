"""Position and heading with odometry at the ten simulated sites of the calibration page. Everything is simulated.

For each site of `calibrate_drives.py`: a calibration without ground truth, and a second drive with corrected ranges and with the
odometry of the simulator (2 % scale error, drift, slip). Printed are the RMSE of the live positions with ranges only, with
odometry, and with odometry and IMU; the RMSE of the heading after 10 m; and the time of driving until the heading is found,
the largest one for eight starts that are 10 s apart. Seeds 0 to 5 were used for development, 10 to 19 are reported.

    python docs/experiments/odometry_sites.py --first 10 --seeds 10
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.sites import Drive
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.robot_estimator import make_estimator
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, RobotData
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.training.site import calibration as site_calibration
from uwb_mitigation.training.site import solution as site_solution
from uwb_mitigation.training.site.data import read_site
from uwb_mitigation.types.tracks import Ranges, TruePath

HEIGHT = Height(0.0, 0.05)
STARTS = 8
START_EVERY_S = 10.0
FOUND_M = 10.0
"""The heading counts after this distance."""


def corrected_drive(seed: int, seconds: float) -> tuple[EstimatorConfig, Ranges, TruePath, RobotData]:
    """Return the configuration, corrected ranges, truth and motion of the second drive at a calibrated site."""
    universal, anchors = load_bundle(default_model_path()), 4 + seed % 5
    first, second = (Drive(seed, number, anchors, seconds) for number in (0, 1))
    site = read_site([list(first)], first.anchors, universal.card)
    solution = site_solution.solve_without_truth(site, universal, height=HEIGHT, area=None)
    calibration = site_calibration.calibrate_site(site, universal, solution, seed=0)
    records = list(second)
    with tempfile.TemporaryDirectory() as folder:
        bundle, _ = calibration.write(Path(folder) / "site.onnx", universal, "drive")
        corrected = Mitigation(bundle, calibration.offsets).correct(
            [record.measurement for record in records]
        )
    stamps = np.array([record.measurement.stamp_ns for record in records], np.int64)
    ranges = Ranges(
        stamps,
        np.array([second.anchors.index[record.measurement.anchor_id] for record in records]),
        np.maximum([one.range_m for one in corrected], 0.0),
        np.array([one.variance_m2 for one in corrected]),
        np.full(len(stamps), np.nan),
        101,
    )
    truth = TruePath(
        stamps,
        np.array([record.tag_position for record in records], float),
        np.array([record.tag_yaw for record in records], float),
    )
    motion = second.motion()
    config = EstimatorConfig(second.anchors, NoiseModel(), HEIGHT)
    return config, ranges, truth, RobotData(motion.odometry, motion.imu)


def found_after_s(config: EstimatorConfig, ranges: Ranges, from_s: float) -> float:
    """Return the time from a start until the heading is known; inf: never."""
    begin_ns = int(ranges.stamp_ns[0]) + round(from_s * 1e9)
    part = ranges.take((ranges.stamp_ns >= begin_ns) & (ranges.stamp_ns < begin_ns + 30_000_000_000))
    track = make_estimator(config).run(part)
    known = np.flatnonzero(np.isfinite(track.yaw[:, 0]))
    return (int(track.stamp_ns[known[0]]) - begin_ns) / 1e9 if len(known) else math.inf


def one(seed: int, seconds: float) -> list[float]:
    """Return the figures of one site."""
    config, ranges, truth, motion = corrected_drive(seed, seconds)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth.position[:, :2], axis=0).T))])
    after_ns = int(truth.stamp_ns[np.searchsorted(driven, FOUND_M)])
    figures = []
    for robot in (None, replace(motion, imu=None), motion):
        began = time.process_time()
        track = make_estimator(replace(config, robot=robot)).run(ranges)
        took_us = (time.process_time() - began) / len(ranges) * 1e6
        heading_deg = track_errors(track.take(track.stamp_ns >= after_ns), truth).heading_rmse_deg
        figures += [track_errors(track, truth).rmse, heading_deg, took_us]
    with_odometry = replace(config, robot=replace(motion, imu=None))
    starts = [found_after_s(with_odometry, ranges, START_EVERY_S * number) for number in range(STARTS)]
    return [*figures, max(starts)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=120.0)
    arguments = parser.parse_args()
    print("RMSE in m, heading in degrees, time per range in us, time until the heading is found in s")
    print("seed  ranges only      odometry               odometry and IMU       found")
    print("        RMSE   time     RMSE heading   time     RMSE heading   time")
    rows = []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        rows.append(one(seed, arguments.seconds))
        _show(str(seed), rows[-1])
    _show("mean", np.mean(rows, axis=0).tolist())


def _show(name: str, row: list[float]) -> None:
    rmse, _, took, *others, found = row
    text = f"{name:>4}   {rmse:.3f}  {took:5.0f}"
    for number in range(0, len(others), 3):
        rmse, heading, took = others[number : number + 3]
        text += f"    {rmse:.3f}   {heading:5.2f}  {took:5.0f}"
    print(f"{text}    {found:5.1f}", flush=True)


if __name__ == "__main__":
    main()
