"""Calibrate simulated sites from a drive without ground truth, and test on a second drive. No radio is involved.

For each seed: a random flat or small office that the universal model was not trained on, 4 to 8 anchors, radios with their
own offsets, one drive for calibration and another one for the test. The result is compared with `train` on the true ranges of
the same drive, and with the universal model and the true offsets.

Seeds 0 to 9 were used for development; results are reported for seeds 10 to 19. Drives that end with an error are
listed, and are not part of the means.

    python docs/experiments/calibrate_drives.py --first 10 --seeds 10 -o drives.json
    python docs/experiments/calibrate_drives.py --first 10 --seeds 3 --truth-topic   # time offset and lever arm
    python docs/experiments/calibrate_drives.py --minutes 30                         # time and memory only
    python docs/experiments/calibrate_drives.py --flat                               # in the simulated flat
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.sites import RATE_HZ, Drive
from uwb_mitigation.calibration import site as site_calibration
from uwb_mitigation.calibration import solution as site_solution
from uwb_mitigation.calibration.site_data import read_site
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import Bundle, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.training import train
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.types.tracks import PosePath, Ranges, TruePath

TIME_OFFSET_S, LEVER_M = 0.3, (0.4, 0.0, 0.0)


def error_of(records: list[Record], bundle: Bundle | None, offsets: Offsets) -> float:
    """Return the MAE of the corrected ranges, m; without a bundle, of the raw ranges."""
    truth = np.array([record.truth.range_m for record in records if record.truth is not None])
    if bundle is None:
        return float(np.abs(np.array([record.measurement.range_m for record in records]) - truth).mean())
    corrected = Mitigation(bundle, offsets).correct([record.measurement for record in records])
    return float(np.abs(np.array([one.range_m for one in corrected]) - truth).mean())


def position_rmse(
    records: list[Record], anchors: AnchorMap, bundle: Bundle | None, offsets: Offsets
) -> float:
    """Return the RMSE of the live track, m."""
    stamps = np.array([record.measurement.stamp_ns for record in records], np.int64)
    truth = TruePath(stamps, np.array([record.tag_position for record in records], float))
    row = np.array([anchors.index[record.measurement.anchor_id] for record in records])
    value = np.array([record.measurement.range_m for record in records])
    variance = np.full(len(value), np.nan)
    if bundle is not None:
        corrected = Mitigation(bundle, offsets).correct([record.measurement for record in records])
        value = np.array([one.range_m for one in corrected])
        variance = np.array([one.variance_m2 for one in corrected])
    ranges = Ranges(stamps, row, np.maximum(value, 0.0), variance, np.full(len(value), np.nan), 101)
    track = TagEstimator(EstimatorConfig(anchors, NoiseModel(), height=Height(0.0, 0.05))).run(ranges)
    return track_errors(track, truth).rmse


def trained(records: list[Record], universal: Bundle, folder: Path) -> Bundle:
    """Run `train --data` on the true ranges of the drive; each metre of a pair is one configuration."""
    dataset = build_dataset(records, universal.preprocessing)
    from uwb_mitigation.mitigation.model.architecture import Remnet
    from uwb_mitigation.training.fit.candidates import Recipe
    from uwb_mitigation.training.fit.options import FitOptions

    recipe = Recipe(Remnet(samples=universal.preprocessing.samples), FitOptions())
    return train.train_new_model(
        train.TrainingJob(dataset, "drive", folder / "trained.onnx", 4), recipe
    ).bundle


def one(seed: int, seconds: float, truth_topic: bool, with_train: bool, flat: bool) -> dict[str, object]:
    """Calibrate and test one site."""
    universal = load_bundle(default_model_path())
    anchors = 4 + seed % 5
    drive, other = (Drive(seed, which, anchors, seconds, flat) for which in (0, 1))
    records = list(drive)
    site = read_site([records], drive.anchors, universal.card)
    began = time.perf_counter()
    height = Height(0.0, 0.05)
    if truth_topic:
        # The robot faces its direction of travel, its antenna is ahead of its frame, and its localisation is late.
        stamps = np.array([record.measurement.stamp_ns for record in records], np.int64)
        antenna = np.array([record.tag_position for record in records], float)
        heading = _headings(antenna)
        frame = antenna - np.stack(
            [LEVER_M[0] * np.cos(heading), LEVER_M[0] * np.sin(heading), np.zeros_like(heading)], axis=1
        )
        noise = np.random.default_rng(seed).normal(0.0, 0.02, frame.shape) * (1.0, 1.0, 0.0)
        quaternion = np.stack(
            [np.zeros_like(heading), np.zeros_like(heading), np.sin(heading / 2), np.cos(heading / 2)], axis=1
        )
        path = PosePath(stamps + round(TIME_OFFSET_S * 1e9), frame + noise, quaternion)
        localisation = site_solution.Localisation("/odom", [[path]], estimate_lever_arm=True)
        solution = site_solution.solve_with_truth(site, universal, localisation, height=height)
    else:
        solution = site_solution.solve_without_truth(site, universal, height=height, area=None)
    found = site_calibration.calibrate_site(site, universal, solution, seed=0)
    took = time.perf_counter() - began
    test = list(other)
    off = np.array(
        [found.solution.pairs[101, k + 1][0] for k in range(anchors) if (101, k + 1) in found.solution.pairs]
    )
    sd = np.array(
        [found.solution.pairs[101, k + 1][1] for k in range(anchors) if (101, k + 1) in found.solution.pairs]
    )
    true = np.array([drive.offset_m[k] for k in range(anchors) if (101, k + 1) in found.solution.pairs])
    known = Offsets(pairs={(101, k + 1): off for k, off in enumerate(drive.offset_m.tolist())})
    with tempfile.TemporaryDirectory() as folder:
        bundle, _ = found.write(Path(folder) / "site.onnx", universal, "drive")
        row: dict[str, object] = {
            "seed": seed,
            "anchors": anchors,
            "size_m": list(drive.plan.size),
            "walls": len(drive.plan.walls),
            "chosen": found.chosen,
            "level": found.solution.offset_level,
            "refused": found.refusal,
            "seconds": took,
            "raw_mae": error_of(test, None, NO_OFFSETS),
            "calibrated_mae": error_of(test, bundle, found.offsets),
            "known_offsets_mae": error_of(test, universal, known),
            "raw_rmse": position_rmse(test, drive.anchors, None, NO_OFFSETS),
            "calibrated_rmse": position_rmse(test, drive.anchors, bundle, found.offsets),
            "known_offsets_rmse": position_rmse(test, drive.anchors, universal, known),
            "offset_mae": float(np.abs(off - true).mean()),
            "offset_worst": float(np.abs(off - true).max()),
            "in_two_sd": float((np.abs(off - true) <= 2.0 * sd).mean()),
            "sd": float(sd.mean()),
        }
        if found.solution.alignment is not None:
            row["time_offset_error"] = found.solution.alignment.time_offset_s - TIME_OFFSET_S
            row["lever_error"] = (found.solution.alignment.lever_arm_m[0] - LEVER_M).tolist()
            row["time_offset_sd"] = found.solution.alignment.time_offset_sd_s
            row["lever_sd"] = found.solution.alignment.lever_arm_sd_m[0].tolist()
        if with_train:
            bundle = trained(records, universal, Path(folder))
            row["trained_mae"] = error_of(test, bundle, NO_OFFSETS)
            row["trained_rmse"] = position_rmse(test, drive.anchors, bundle, NO_OFFSETS)
    return row


def _headings(position: np.ndarray) -> np.ndarray:
    """Return the direction of travel, averaged over two seconds, because no robot turns instantly."""
    ahead = np.minimum(np.arange(len(position)) + 20, len(position) - 1)
    before = np.maximum(np.arange(len(position)) - 20, 0)
    away = position[ahead] - position[before]
    heading = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    window = round(2.0 * RATE_HZ)
    padded = np.pad(heading, (window // 2, window - window // 2 - 1), mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), mode="valid")


def speed(minutes: float) -> dict[str, object]:
    """Measure time and memory for one long drive."""
    universal = load_bundle(default_model_path())
    drive = Drive(1, 0, 6, 60.0 * minutes)
    site = read_site([drive], drive.anchors, universal.card)
    began, cpu = time.perf_counter(), time.process_time()
    solution = site_solution.solve_without_truth(site, universal, height=Height(0.0, 0.05), area=None)
    found = site_calibration.calibrate_site(site, universal, solution, seed=0)
    return {
        "minutes": minutes,
        "ranges": sum(map(len, site.tags)),
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "chosen": found.chosen,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--minutes", type=float, help="one drive of this duration, for time and memory")
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--truth-topic", action="store_true")
    parser.add_argument("--no-train", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    rows, num_stopped = [], 0
    if arguments.minutes:
        rows.append(speed(arguments.minutes))
        print(json.dumps(rows[0]))
    else:
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            try:
                row = one(
                    seed, arguments.seconds, arguments.truth_topic, not arguments.no_train, arguments.flat
                )
                rows.append(row)
            except DatasetError as error:
                row = {"seed": seed, "refused": str(error)}
                num_stopped += 1
            print(
                json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}),
                flush=True,
            )
        if not rows:
            return
        numbers = [key for key, value in rows[0].items() if isinstance(value, float)]
        mean = {key: round(math.fsum(float(row[key]) for row in rows) / len(rows), 4) for key in numbers}  # type: ignore[arg-type]
        # A refused calibration is not written: the robot continues with raw ranges.
        ratio = [1.0 if row["refused"] else row["calibrated_rmse"] / row["raw_rmse"] for row in rows]  # type: ignore[operator]
        ratio += [1.0] * num_stopped
        of_live = {"mean": round(float(np.mean(ratio)), 3), "max": round(max(ratio), 3)}
        print(json.dumps({"drives": len(rows), "mean": mean, "calibrated_to_raw_rmse": of_live}))
    if arguments.output:
        arguments.output.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
