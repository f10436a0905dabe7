"""Calibrate on one drive, and compare the live positions of another drive of the same site with and without the result.

Sets: `cirs`, simulated buildings that the universal model was not trained on, whose radios have offsets of their own; `levels`,
the same ranges without CIRs; `bare`, also without powers; `flat` and `flat_levels`, a simulated flat whose radios have none;
`geometry`, layouts of real deployments in two and three dimensions; `hanyang`, every ordered pair of real drives with the same anchors; `labyrinth`, the
halves of a short real drive. With `--check`, a third drive is the check of the calibration. With `--truth`, the true positions of the
first drive are the ground truth of the calibration. With `--force`, refused offsets of single anchors are tested, too, if the ranges
have no CIRs: the change that a refusal prevents.

What refusals cost without CIRs: live RMSE with / without offsets of single anchors, on one or two other drives. Development seeds: `bare` 103, 104, 108,
109, 118, 119, 713 and 714, `geometry` 710 to 717, and 219, 304, 347 and 368, which were chosen because of known losses or gains. Fresh
seeds: `bare` 623, 624, 628, 629 and 633, `geometry` 620 to 626 (rings, one box, one scattered layout). From seed 714 on, layouts had rates of 20 Hz.

    refused because              development                                               fresh
    skewed errors                0.66 0.83 0.83 0.84 0.85 0.91 0.93 1.04 (304) 1.11 (118)  0.55 0.73 0.74 0.95
    displaced track              0.84 (109), 1.09 (347, box in 3-D)                        0.88 1.01
    too few anchors              0.85 0.87 0.96 0.96 0.98 0.98 1.02 1.02 1.04
    small promise                0.79 0.92 0.95 0.95 1.03 (219)                            0.91 0.92 0.95
    an offset is not observable  0.77
    accepted                     0.48 0.49 0.66 0.70 0.73 0.77 0.88 0.91                   0.55 0.75 0.85 0.91 0.92

The promise holds in all 13 accepted drives. The offsets' covariance does not separate losses and gains: the decrease of the squared
displacement of positions that it predicts is 1.2 to 2.4 times its standard deviation in the five losses, 0.3 to 6.4 times in gains. Neither does the held-out gain (0.10 to 0.39 and
0.01 to 0.45), nor a smaller promise for symmetric errors, which accepts 219. The correlation of these displacements between the
offsets of both halves is the best candidate: with seven anchors or more it is at most 0.95 in losses (347; 0.90: 118), and 0.98 or more in
five refused gains of the development seeds (0.66 to 0.93); but it is 0.98 in the loss with four anchors. Of the nine refused fresh
drives, 0.97 or more accepts two (0.73 and 0.74, `bare` 628 and 633): too few to decide.
Without the part that looks like a displacement, half of the offsets give 0.95 instead of 1.11 (118) and 0.87 instead of 1.04 (304), but
1.09 as before (347) and 0.99 instead of 0.73 (ring 716).

Printed for each pair: the correction, the promised change of the live position error, its change on the other drive, RMSE without
and with the calibration; or the reason of the refusal. Without a calibration, the ranges are corrected by the shipped model if they
have CIRs, otherwise raw. Seeds below 200, from 700 on, and those that the code names were used for development.

    PYTHONPATH=. python docs/experiments/calibrate_drives.py cirs bare flat geometry --first 200 --seeds 2
    PYTHONPATH=. python docs/experiments/calibrate_drives.py levels hanyang --check -o drives.jsonl
    PYTHONPATH=. python docs/experiments/calibrate_drives.py geometry --only 'ceiling|corridor|outdoor' --first 380 --seeds 8
    PYTHONPATH=. python docs/experiments/calibrate_drives.py cirs levels --truth --first 200 --seeds 2
    PYTHONPATH=. python docs/experiments/calibrate_drives.py bare geometry --force --first 620 --seeds 7
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks import position_data
from benchmarks.position_data import Run, RunSource, load_geometry, real_runs
from uwb_mitigation.calibration.site import SiteCalibration, calibrate_site
from uwb_mitigation.calibration.site_data import SiteData, read_site
from uwb_mitigation.calibration.solution import PAIR, Localisation, solve_with_truth, solve_without_truth
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.types.tracks import PosePath, Ranges

EMPTY = np.zeros(0, np.int16)
UNIVERSAL = load_bundle(default_model_path())
DRIVES = 3
"""Drives of a site: for the calibration, for its check, and for the test."""

SITES = ("cirs", "levels", "bare")


@dataclass(frozen=True)
class Case:
    """A function that returns the three drives of a case."""

    kind: str
    name: str
    load: Callable[[], list[Run]]


def site_runs(kind: str, seed: int) -> list[Run]:
    """Return the drives at a simulated site."""
    runs = [position_data.load_site("site", str(k), seed, k) for k in range(DRIVES)]
    return runs if kind == "cirs" else [_without_cirs(run, has_levels=kind == "levels") for run in runs]


def flat_runs(kind: str, anchors: int, first: int) -> list[Run]:
    """Return the drives in the simulated flat."""
    runs = [position_data.load_flat("flat", str(k), anchors, first * DRIVES + k) for k in range(DRIVES)]
    return runs if kind == "flat" else [_without_cirs(run, has_levels=True) for run in runs]


def _without_cirs(run: Run, *, has_levels: bool) -> Run:
    def read_records() -> list[Record]:
        records = []
        for record in run.read_records():
            cir = record.measurement.cir
            levels = (cir.rx_power_dbm, cir.first_path_power_dbm) if has_levels else (np.nan, np.nan)
            bare = Cir(EMPTY, rx_power_dbm=levels[0], first_path_power_dbm=levels[1])
            records.append(replace(record, measurement=replace(record.measurement, cir=bare)))
        return records

    return replace(run, read_records=read_records, has_cirs=False)


def geometry_runs(file: str, layout: str, dims: int, seed: int) -> list[Run]:
    """Return parts of one long drive, so that anchors and reflections have the same errors in all of them."""
    seconds = DRIVES * position_data.DRIVE_S
    return _parts(load_geometry("geometry", "", file, layout, dims, seed, seconds), DRIVES)


def _parts(run: Run, count: int) -> list[Run]:
    edges = np.linspace(run.ranges.stamp_ns[0], run.ranges.stamp_ns[-1] + 1, count + 1)
    parts = []
    for low, high in itertools.pairwise(edges):
        ranges = run.ranges.take((run.ranges.stamp_ns >= low) & (run.ranges.stamp_ns < high))
        truth = run.truth.take((run.truth.stamp_ns >= low) & (run.truth.stamp_ns < high))
        records = _records(run, ranges)
        parts.append(replace(run, ranges=ranges, truth=truth, read_records=lambda records=records: records))
    return parts


def half_runs(source: RunSource) -> list[Run]:
    """Return the halves of a run; the second one is also the check."""
    first, second = _parts(source.read(), 2)
    return [first, second, second]


def _records(run: Run, ranges: Ranges) -> list[Record]:
    ids = [anchor.id for anchor in run.anchors.anchors]
    columns = ranges.stamp_ns, ranges.anchor, ranges.range_m, ranges.rx_power_dbm
    return [
        Record(
            RangeMeasurement(
                stamp, ranges.tag_id, ids[row], n % 256, 0, range_m, Cir(EMPTY, rx_power_dbm=power)
            )
        )
        for n, (stamp, row, range_m, power) in enumerate(zip(*(c.tolist() for c in columns), strict=True))
    ]


def cases(kinds: list[str], seeds: range, data: Path) -> Iterator[Case]:
    """Yield the cases of each set."""
    for kind in kinds:
        if kind in SITES:
            for seed in seeds:
                yield Case(kind, str(seed), lambda kind=kind, seed=seed: site_runs(kind, seed))
        elif kind in ("flat", "flat_levels"):
            for anchors, seed in itertools.product((4, 6, 8), seeds):
                arguments = kind, anchors, seed
                yield Case(
                    kind, f"{anchors} anchors {seed}", lambda arguments=arguments: flat_runs(*arguments)
                )
        elif kind == "geometry":
            file = next(data.glob(f"*/{position_data.GEOMETRIES}"), None)
            if file is None:
                raise SystemExit(f"{data} has no {position_data.GEOMETRIES}: set --data")
            layouts = [layout["name"] for layout in yaml.safe_load(file.read_text())["geometries"]]
            for arguments in itertools.product([str(file)], layouts, (2, 3), seeds):
                name = "{1} {2}-D {3}".format(*arguments)
                yield Case(kind, name, lambda arguments=arguments: geometry_runs(*arguments))
        else:
            sources = [source for source in real_runs(data)[0] if source.set_name == kind]
            for source in sources if len(sources) == 1 else []:
                yield Case(kind, source.name, lambda source=source: half_runs(source))
            for first, second in itertools.permutations(sources, 2):
                third = next(source for source in sources if source not in (first, second))
                drives = first, third, second
                yield Case(
                    kind, f"{first.name} to {second.name}", lambda drives=drives: [d.read() for d in drives]
                )


def live_rmse_m(run: Run, ranges: Ranges) -> float:
    """Return the RMSE of the live position."""
    track = live_track(
        EstimatorConfig(run.anchors, height=run.height, area=run.area, heights=run.heights), ranges
    )
    return track_errors(track, run.truth).rmse if len(track) else np.nan


def calibrated(drive: Run, check: Run | None, *, has_truth: bool = False) -> SiteCalibration:
    """Return the calibration of a drive."""

    def read(run: Run) -> SiteData:
        heights = None if run.heights is None else [run.heights]
        return read_site([run.read_records()], run.anchors, UNIVERSAL, heights=heights)

    site = read(drive)
    if has_truth:
        poses = PosePath(
            drive.truth.stamp_ns,
            drive.truth.position,
            np.tile([0.0, 0.0, 0.0, 1.0], (len(drive.truth.stamp_ns), 1)),
        )
        paths = {tag.tag_id: [poses] for tag in site.tags}
        localisation = Localisation("/truth", paths, time_offset_s=0.0)
        solution = solve_with_truth(site, localisation, height=drive.height)
    else:
        solution = solve_without_truth(site, height=drive.height, area=drive.area)
    return calibrate_site(site, UNIVERSAL, solution, check=[] if check is None else [read(check)])


def evaluate(case: Case, *, has_check: bool, has_truth: bool, is_forced: bool = False) -> dict[str, Any]:
    """Calibrate and test one case; `is_forced`: without CIRs always with offsets of single anchors."""
    drive, check, test = case.load()
    row: dict[str, Any] = {"kind": case.kind, "case": case.name, "raw_m": live_rmse_m(test, test.ranges)}
    row["without_m"] = live_rmse_m(test, test.corrected()) if test.has_cirs else row["raw_m"]
    began = time.process_time()
    try:
        found = calibrated(drive, check if has_check else None, has_truth=has_truth)
    except DatasetError as error:
        return row | {"refused": str(error), "seconds": time.process_time() - began}
    row |= {
        "seconds": time.process_time() - began,
        "refused": found.refusal,
        "chosen": found.chosen,
        "promised": found.live_position_change,
        "offsets": [value for value, _ in found.pairs.values()],
        "offset_sds": [sd for _, sd in found.pairs.values()],
    }
    if is_forced and found.refusal and not test.has_cirs:
        row["chosen"] = "offsets, forced"
        found = replace(found, level=PAIR)
    with tempfile.TemporaryDirectory() as folder:
        bundle, _ = found.write(Path(folder) / "site.onnx", UNIVERSAL, "drive")
        corrected = test.corrected(bundle, found.offsets)
    row["calibrated_m"] = live_rmse_m(test, corrected)
    row["change"] = row["calibrated_m"] / row["without_m"] - 1.0
    return row


def show(row: dict[str, Any]) -> None:
    text = f"{row['kind']:9} {row['case']:32} "
    if "chosen" in row:
        text += f"{row['chosen']:42} promised {row['promised']:+.2f} actual {row['change']:+.2f} "
        text += f"(raw {row['raw_m']:.3f}, {row['without_m']:.3f} to {row['calibrated_m']:.3f} m) "
    print(text + (f"REFUSED: {row['refused']}" if row["refused"] else ""), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="+", metavar="SET")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", metavar="PATTERN", help="only cases with such names")
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--check", action="store_true")
    choice.add_argument("--truth", action="store_true")
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--data", type=Path, default=os.environ.get("UWB_MITIGATION_DATA", "../shared/data"))
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    accepted: dict[str, list[dict[str, Any]]] = defaultdict(list)
    counts: dict[str, int] = defaultdict(int)
    for case in cases(
        arguments.kinds, range(arguments.first, arguments.first + arguments.seeds), arguments.data
    ):
        if not re.search(arguments.only, case.name):
            continue
        row = evaluate(case, has_check=arguments.check, has_truth=arguments.truth, is_forced=arguments.force)
        show(row)
        counts[case.kind] += 1
        accepted[case.kind] += [] if row["refused"] else [row]
        if arguments.output:
            with arguments.output.open("a") as stream:
                stream.write(json.dumps(row, default=float) + "\n")
    for kind, rows in accepted.items():
        changes = np.array([row["change"] for row in rows] or [0.0])
        kept = np.mean([row["change"] <= row["promised"] + 0.02 for row in rows] or [1.0])
        print(
            f"{kind}: {len(rows)} of {counts[kind]} accepted; live RMSE with / without: mean {1.0 + changes.mean():.2f}, "
            f"largest {1.0 + changes.max():.2f}; promise kept (within 2 %) by {kept:.0%}"
        )


if __name__ == "__main__":
    main()
