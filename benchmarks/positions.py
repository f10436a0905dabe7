"""Measure the chain from raw ranges to positions, next to simple filters. Needs neither ROS nor torch (except for calibration).

Every row is evaluated at the ranges from `WARM_UP_S` after the first one on, against the true path. The ratio to the best baseline
compares the locator on raw ranges with the baselines at the times at which all of them have an estimate.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines import run_ekf
from benchmarks.position_data import Run, RunSource, geometry_runs, real_runs, simulated_runs
from uwb_mitigation.errors import DatasetError, UwbMitigationError
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.initialization import snapshot
from uwb_mitigation.positioning.online.robot_estimator import make_estimator
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Odometry, Ranges, Track, TruePath

WARM_UP_S = 5.0
"""As long as a heading takes to be found."""

PUBLISHED_AFTER_S = 10.0
"""Positions are due from this time on."""

HEADING_FAULTS = ("world axes", "sign of yaw rate", "late by 1 s")
"""Faults of odometry that make headings wrong as long as they exist."""

BASELINE_OFFSET_SD_M = 0.15
BASELINES = ("raw_least_squares", "raw_ekf", "raw_ekf_offset")
ROWS = (
    *BASELINES,
    "raw_locator",
    "corrected_locator",
    "calibrated_locator",
    "odometry_locator",
    "corrected_odometry_locator",
    "smoothed",
)
SCORES = (
    "rmse_m",
    "median_m",
    "p95_m",
    "coverage95",
    "nees_per_dof",
    "protection_exceeded",
    "height_rmse_m",
    "height_coverage95",
    "height_exceeded",
)


def evaluate(source: RunSource, *, calibrate: bool = True, complete: bool = True) -> dict[str, Any]:
    """Return the entry of a run, if `complete` with a smoothed track and with wrong odometry.

    Raises:
        UwbMitigationError: it cannot be read, or has no estimate to compare.
    """
    run = source.read()
    if len(run.ranges) < 20 or len(run.truth) < 10:
        raise DatasetError(f"{len(run.ranges)} ranges and {len(run.truth)} true positions")
    tracks: dict[str, tuple[Track, float]] = {}
    failed: dict[str, str] = {}
    truth = _after_warm_up(run)

    def add(row: str, make: Callable[[], Track], count: int = len(run.ranges)) -> None:
        began = time.process_time()
        try:
            tracks[row] = make(), (time.process_time() - began) / count * 1e6
        except (UwbMitigationError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            failed[row] = f"{type(error).__name__}: {error}"

    ekf = partial(run_ekf, run.anchors, run.ranges, height=run.height, heights=run.heights)
    add("raw_least_squares", lambda: snapshot(run.anchors, run.ranges, run.height))
    start = tracks["raw_least_squares"][0]
    add("raw_ekf", lambda: ekf(start))
    add("raw_ekf_offset", lambda: ekf(start, offset_sd_m=BASELINE_OFFSET_SD_M))
    add("raw_locator", lambda: locate(run, run.ranges))
    if run.has_cirs:
        add("corrected_locator", lambda: locate(run, run.corrected()))
    if source.donor is not None and calibrate:
        donor = source.donor
        add("calibrated_locator", lambda: locate(run, calibrated(run, donor.read())))
    if run.robot is not None:
        add("odometry_locator", lambda: locate(run, run.ranges, run.robot))
        if run.has_cirs:
            add("corrected_odometry_locator", lambda: locate(run, run.corrected(), run.robot))
    if complete and "raw_locator" in tracks:
        config = EstimatorConfig(run.anchors, NoiseModel(), run.height, run.area, run.heights)
        add("smoothed", lambda: smooth(config, run.ranges, tracks["raw_locator"][0]))
    rows = {
        row: errors | {"us_per_range": took_us}
        for row, (track, took_us) in tracks.items()
        if (errors := scores(track, truth)) is not None
    }
    result: dict[str, Any] = {
        "name": run.set_name,
        "run": run.name,
        "simulated": run.simulated,
        "epochs": rows.get("raw_locator", {}).get("epochs", 0),
        "published": _published(run, tracks),
        "rows": rows,
        "failed": failed,
        "best_baseline": None,
        "ratio_to_best_baseline": None,
        "corrected_to_raw": None,
    }
    if "raw_locator" in rows:
        result |= _ratio(tracks, truth)
        if "corrected_locator" in rows:
            result["corrected_to_raw"] = rows["corrected_locator"]["rmse_m"] / rows["raw_locator"]["rmse_m"]
    if run.robot is not None and "odometry_locator" in rows and (complete or run.height is not None):
        result |= _with_faults(run, tracks, truth, HEADING_FAULTS if not complete else None)
    return result


def locate(run: Run, ranges: Ranges, robot: RobotData | None = None) -> Track:
    """Return the live track of the product.

    Raises:
        DatasetError: no position was determined.
    """
    config = EstimatorConfig(run.anchors, NoiseModel(), run.height, run.area, run.heights, robot)
    track = make_estimator(config).run(ranges)
    if len(track) < 2:
        raise DatasetError("no position was determined")
    return track


def calibrated(run: Run, donor: Run) -> Ranges:
    """Return the ranges of a run with the calibration from another one, which is made without ground truth.

    Raises:
        DatasetError: the calibration was refused.
    """
    from uwb_mitigation.calibration.site import calibrate_site
    from uwb_mitigation.calibration.site_data import read_site
    from uwb_mitigation.calibration.solution import solve_without_truth
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import default_model_path

    universal = load_bundle(default_model_path())
    heights = None if donor.heights is None else [donor.heights]
    site = read_site([donor.read_records()], donor.anchors, universal, heights=heights)
    solution = solve_without_truth(site, height=donor.height, area=donor.area)
    calibration = calibrate_site(site, universal, solution)
    if calibration.refusal:
        raise DatasetError(f"refused: {calibration.summary()}")
    with tempfile.TemporaryDirectory() as folder:
        bundle, _ = calibration.write(Path(folder) / "site.onnx", universal, "drive")
        return run.corrected(bundle, calibration.offsets)


def scores(track: Track, truth: TruePath) -> dict[str, Any] | None:
    """Return the errors of a track at its own times; None: it has no estimate with a true position."""
    errors = track_errors(track, truth)
    if not errors.epochs:
        return None
    values = errors.as_json()
    values["rmse_m"] = values.pop("horizontal_rmse_m")
    values["rmse_3d_m"] = math.hypot(errors.rmse, errors.height_rmse)
    return {key: values[key] for key in (*SCORES, "epochs", "rmse_3d_m", "heading_rmse_deg")}


def _after_warm_up(run: Run) -> TruePath:
    begin_ns = int(run.ranges.stamp_ns[0]) + round(WARM_UP_S * NS_PER_S)
    return run.truth.take(run.truth.stamp_ns >= begin_ns)


def _published(run: Run, tracks: dict[str, tuple[Track, float]]) -> float:
    """Return the share of the ranges with a true position that have a live one, after `PUBLISHED_AFTER_S`."""
    stamps = run.ranges.stamp_ns
    is_due = np.isfinite(run.truth.position_at(stamps)[:, 0])
    is_due &= stamps >= stamps[0] + round(PUBLISHED_AFTER_S * NS_PER_S)
    if "raw_locator" not in tracks or not is_due.any():
        return 0.0
    return float(np.isin(stamps[is_due], tracks["raw_locator"][0].stamp_ns).mean())


def _ratio(tracks: dict[str, tuple[Track, float]], truth: TruePath) -> dict[str, Any]:
    """Compare with the baselines at the times of all of them; least squares has positions at some of the ranges only."""
    compared = {row: tracks[row][0] for row in ("raw_ekf", "raw_ekf_offset", "raw_locator")}
    stamps = compared["raw_locator"].stamp_ns
    for track in compared.values():
        stamps = np.intersect1d(stamps, track.stamp_ns)
    errors = {
        row: scores(track.take(np.isin(track.stamp_ns, stamps)), truth) for row, track in compared.items()
    }
    errors["raw_least_squares"] = scores(tracks["raw_least_squares"][0], truth)
    compared_errors = {row: error for row, error in errors.items() if error is not None}
    if "raw_locator" not in compared_errors or len(compared_errors) < 2:
        return {}
    locator = compared_errors.pop("raw_locator")
    best = min(compared_errors, key=lambda row: float(compared_errors[row]["rmse_m"]))
    best_3d = min(error["rmse_3d_m"] for error in compared_errors.values())
    return {
        "best_baseline": best,
        "ratio_to_best_baseline": locator["rmse_m"] / compared_errors[best]["rmse_m"],
        "ratio_3d_to_best_baseline": locator["rmse_3d_m"] / best_3d,
    }


def _twists(odometry: Odometry, change: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Odometry:
    """Return odometry without poses and with changed twists (n, 3)."""
    return replace(odometry, pose=np.full_like(odometry.pose, np.nan), twist=change(odometry.twist))


def _in_world_axes(twist: NDArray[np.float64], stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    yaw = np.cumsum(twist[:, 2] * np.diff(stamp_ns / NS_PER_S, prepend=stamp_ns[0] / NS_PER_S))
    x, y, rate = twist.T
    rotated: NDArray[np.float64] = np.stack(
        [np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, rate], axis=1
    )
    return rotated


def _with_turn(twist: NDArray[np.float64], stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    turned: NDArray[np.float64] = twist.copy()
    middle = len(turned) // 2
    turned[middle, 2] += math.pi / 2.0 / ((stamp_ns[middle] - stamp_ns[middle - 1]) / NS_PER_S)
    return turned


def odometry_faults(odometry: Odometry) -> dict[str, Odometry]:
    """Return wrong odometry, {fault: messages}."""
    stamps = odometry.stamp_ns
    return {
        "world axes": _twists(odometry, lambda twist: _in_world_axes(twist, stamps)),
        "sign of yaw rate": _twists(odometry, lambda twist: twist * (1.0, 1.0, -1.0)),
        "scale 0.5": _twists(odometry, lambda twist: twist * (0.5, 0.5, 1.0)),
        "jump of 90 degrees": _twists(odometry, lambda twist: _with_turn(twist, stamps)),
        "stuck at zero": _twists(odometry, lambda twist: twist * 0.0),
        "late by 1 s": replace(odometry, stamp_ns=stamps + NS_PER_S),
    }


def _with_faults(
    run: Run, tracks: dict[str, tuple[Track, float]], truth: TruePath, names: Sequence[str] | None
) -> dict[str, Any]:
    """Return the RMSE with wrong odometry relative to ranges only, and how often headings are published and wrong.

    Args:
        run: with odometry.
        tracks: of it.
        truth: true path on which positions are evaluated.
        names: of faults; None: all.
    """
    assert run.robot is not None
    assert run.robot.odometry is not None
    ranges_only, track = scores(tracks["raw_locator"][0], truth), tracks["odometry_locator"][0]
    headings, ratios = {"correct": _heading_shares(track, run.truth)}, {}
    for fault, odometry in odometry_faults(run.robot.odometry).items():
        if names is not None and fault not in names:
            continue
        track = locate(run, run.ranges, replace(run.robot, odometry=odometry))
        headings[fault] = _heading_shares(track, run.truth)
        faulty = scores(track, truth)
        if ranges_only and faulty:
            ratios[fault] = faulty["rmse_m"] / ranges_only["rmse_m"]
    return {"odometry_faults": ratios, "headings": headings}


def _heading_shares(track: Track, truth: TruePath) -> dict[str, float]:
    """Return the share of estimates with a heading, and of these the share with an error above 3.29 standard deviations."""
    wrong = track_errors(track, truth).heading_exceeded
    published = float(np.isfinite(track.yaw[:, 0]).mean())
    return {"published": published, "wrong": wrong if math.isfinite(wrong) else 0.0}


def ambiguous_drives() -> list[dict[str, Any]]:
    """Return the errors beyond the protection levels where anchors do not exclude a mirror image (simulated).

    The area excludes the image only if the tag stays on one side. Otherwise it starts with another anchor, which is received
    for the first ten seconds.
    """
    line = [(0.0, 0.0, 1.5), (5.0, 0.0, 1.5), (10.0, 0.0, 1.5)]
    results = []
    for kind, places in (("two anchors", line[::2]), ("three collinear anchors", line)):
        for crosses in (False, True):
            for seed in range(3):
                track, truth, count = _ambiguous_drive(places, crosses, seed)
                errors = track_errors(track, truth)
                results.append(
                    {
                        "name": f"{kind}, {'crossing the line' if crosses else 'one side'}",
                        "seed": seed,
                        "protection_exceeded": errors.exceeded if errors.epochs else 0.0,
                        "availability": len(track) / count,
                    }
                )
    return results


def _ambiguous_drive(
    places: list[tuple[float, float, float]], crosses: bool, seed: int
) -> tuple[Track, TruePath, int]:
    rng, n = np.random.default_rng(seed), 2400
    places = [*places, (5.0, 7.0, 1.5)] if crosses else places
    anchors = AnchorMap([Anchor(number, place, 0.02) for number, place in enumerate(places, 1)])
    time_s = np.arange(n) / 40.0
    received = len(places) - crosses * (time_s > 10.0)
    row = (np.arange(n) % received).astype(np.intp)
    y = 0.5 + 2.5 * np.cos(0.2 * time_s) if crosses else 2.5 + np.cos(0.2 * time_s)
    position = np.stack([5.0 + 3.0 * np.sin(0.17 * time_s), y, np.ones(n)], axis=1)
    distance = np.linalg.norm(position - anchors.position[row], axis=1)
    stamps = np.rint(time_s * 1e9).astype(np.int64)
    unknown = np.full(n, np.nan)
    ranges = Ranges(stamps, row, distance + rng.normal(0.05, 0.05, n), unknown, unknown)
    area = None if crosses else Area((-1.0, -0.5, 0.0), (11.0, 8.0, 2.0))
    config = EstimatorConfig(anchors, NoiseModel(), Height(1.0, 0.05), area)
    return make_estimator(config).run(ranges), TruePath(stamps, position), n


def measure(
    data: Path | None, *, calibrate: bool, simulated: bool, advance: Callable[[str, float], None]
) -> dict[str, Any]:
    """Return the result of `python -m benchmarks positions`.

    Args:
        data: folder with one folder for each data set; None: simulated drives only.
        calibrate: also calibrate on another run; this takes most of the time.
        simulated: also evaluate simulated drives.
        advance: called with the last run and the finished share.
    """
    sources, skipped = ([], []) if data is None else real_runs(data)
    sources += simulated_runs() if simulated else []
    num_complete = len(sources)
    sources += geometry_runs(data) if data is not None and simulated else []
    results: dict[int, dict[str, Any]] = {}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = {
            pool.submit(evaluate, source, calibrate=calibrate, complete=number < num_complete): number
            for number, source in enumerate(sources)
        }
        for num_finished, future in enumerate(as_completed(futures), 1):
            number = futures[future]
            name = f"{sources[number].set_name} {sources[number].name}"
            try:
                results[number] = future.result()
            except Exception as error:  # The other runs continue.
                skipped.append({"path": name, "reason": f"{type(error).__name__}: {error}"})
            advance(name, num_finished / len(sources))
    sets = [results[number] for number in sorted(results)]
    ambiguous = ambiguous_drives() if simulated else []
    return {"sets": sets, "ambiguous": ambiguous, "summary": summarise(sets, ambiguous), "skipped": skipped}


def summarise(sets: Sequence[dict[str, Any]], ambiguous: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures that summarise all runs, and those of each set."""
    names = list(dict.fromkeys(entry["name"] for entry in sets))
    by_set = {name: _summary_of([entry for entry in sets if entry["name"] == name]) for name in names}
    exceeded = [entry["protection_exceeded"] for entry in ambiguous]
    return {
        **_summary_of(sets),
        "ambiguous_protection_exceeded": max(exceeded) if exceeded else None,
        "by_set": by_set,
    }


def _summary_of(sets: Sequence[dict[str, Any]]) -> dict[str, Any]:
    def values(read: Callable[[dict[str, Any]], Any]) -> list[float]:
        present = []
        for entry in sets:
            try:
                value = read(entry)
            except KeyError:
                continue
            present += [] if value is None else [float(value)]
        return present or [math.nan]

    def row(entry: dict[str, Any], name: str, score: str = "rmse_m") -> float:
        return float(entry["rows"][name][score])

    ratio = values(lambda entry: entry["ratio_to_best_baseline"])
    coverage = values(lambda entry: row(entry, "raw_locator", "coverage95"))
    published = values(lambda entry: entry["published"])
    height = values(lambda entry: row(entry, "raw_locator", "height_exceeded"))
    exceeded = values(lambda entry: row(entry, "raw_locator", "protection_exceeded"))
    nees = values(lambda entry: row(entry, "raw_locator", "nees_per_dof"))
    by_calibration = values(lambda entry: row(entry, "calibrated_locator") / row(entry, "raw_locator"))
    by_correction = values(lambda entry: entry["corrected_to_raw"])
    by_odometry = values(lambda entry: row(entry, "odometry_locator") / row(entry, "raw_locator"))
    faults = values(lambda entry: max(entry["odometry_faults"].values()))
    published_headings = values(lambda entry: entry["headings"]["correct"]["published"])
    wrong_headings = values(
        lambda entry: max(entry["headings"][fault]["wrong"] for fault in ("correct", *HEADING_FAULTS))
    )
    summary = {
        "runs": len(sets),
        "ratio_mean": float(np.mean(ratio)),
        "ratio_max": max(ratio),
        "coverage95_min": min(coverage),
        "coverage95_max": max(coverage),
        "nees_per_dof_min": min(nees),
        "nees_per_dof_max": max(nees),
        "published_min": min(published),
        "protection_exceeded_max": max(exceeded),
        "height_exceeded_max": max(height),
        "corrected_to_raw_mean": float(np.mean(by_correction)),
        "corrected_to_raw_max": max(by_correction),
        "calibrated_to_raw_mean": float(np.mean(by_calibration)),
        "calibrated_to_raw_max": max(by_calibration),
        "odometry_to_raw_mean": float(np.mean(by_odometry)),
        "odometry_fault_ratio_max": max(faults),
        "heading_published_mean": float(np.mean(published_headings)),
        "heading_published_min": min(published_headings),
        "heading_wrong_max": max(wrong_headings),
    }
    return {key: value if math.isfinite(value) else None for key, value in summary.items()}
