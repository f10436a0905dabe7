"""Compare simulated with real ranges: levels and errors of the EVK1000 logs, and how errors change along a drive.

`PYTHONPATH=. python docs/experiments/simulator_against_logs.py FOLDER`, with the folder of the data sets (docs/background/contributing.md). The first table contains percentiles (5, 50, 95) of error in metres,
receive level, power gap, preamble count, threshold and peak, and the MAE before and after the subtraction of a linear bias model that is fitted to
the real logs. The second one describes errors around their mean over a drive, limited to 0.5 m around their median: standard deviation in metres;
share of white noise (half the variance of differences of successive ranges of an anchor); mean correlation of two anchors at the
same time; and correlation of the errors of an anchor by the distance driven. Last, the noise of pairs at rest.
"""

import sys
from pathlib import Path

import numpy as np

from benchmarks.position_data import real_runs, simulated_run
from benchmarks.sites import Drive
from uwb_mitigation.recordings.decaranging import DecaRangingFolder
from uwb_mitigation.simulation.simulated import SimulatedBuildings, SimulatedSource
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias

COUNT, MIN_RANGES = 6000, 30
LIMIT_M = 0.5
DRIVEN_M = np.array([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0])
KINDS, SEEDS = ("open", "plasterboard", "brick", "concrete", "site", "drone_room"), range(4)


def print_levels(logs: Path) -> None:
    line = None
    for source in (DecaRangingFolder(logs), SimulatedSource(seed=1, count=COUNT)):
        rows = []
        for record in source:
            m, truth = record.measurement, record.truth
            rx, gap = m.cir.rx_power_dbm, m.cir.rx_power_dbm - m.cir.first_path_power_dbm
            if truth and np.isfinite([rx, gap]).all():
                taps = m.cir.samples.reshape(-1, 2).astype(float)
                peak = np.sqrt(np.hypot(*taps.T).max() / 60 / m.cir.preamble_count)
                radio = (rx, gap, m.cir.preamble_count, m.cir.noise_threshold, peak)
                rows.append((truth.label, truth.configuration, m.range_m - truth.range_m, *radio))
        label, configuration = (np.array(c) for c in list(zip(*rows, strict=True))[:2])
        error, rx, gap, count, threshold, peak = np.array([r[2:] for r in rows]).T
        if line is None:
            line = fit_linear_bias(configuration, rx, rx - gap, error)
            print(line)
        left = error - (line.offset_m + line.per_rx_power * rx + line.per_power_gap * gap)
        print(source.name, dict(source.skipped))
        for name in ("LOS", "NLOS", "NDP NLOS", ""):
            here = (label == name) | (name == "")
            shown = (error, rx, gap, count, threshold, peak)
            q = [np.percentile(c[here], (5, 50, 95)).round(2).tolist() for c in shown]
            raw, corrected = np.abs(error[here]).mean(), np.abs(left[here]).mean()
            print(f"{name or 'all':9}{here.sum():5}", *q, f"MAE {raw:.3f}, less line {corrected:.3f}")


def errors_by_anchor(run):
    """Return times in s, distances driven in m and errors in m of each anchor, [(n,), (n,), (n,)]."""
    ranges, truth = run.ranges, run.truth
    position = truth.position_at(ranges.stamp_ns)
    error = ranges.range_m - np.linalg.norm(position - run.anchors.position[ranges.anchor], axis=1)
    steps = np.linalg.norm(np.diff(truth.position, axis=0), axis=1)
    driven = np.interp(ranges.stamp_ns, truth.stamp_ns, np.append(0.0, np.cumsum(steps)))
    anchors = []
    for anchor in range(len(run.anchors)):
        rows = np.isfinite(error) & (ranges.anchor == anchor)
        if rows.sum() >= MIN_RANGES:
            median = np.median(error[rows])
            limited = np.clip(error[rows], median - LIMIT_M, median + LIMIT_M)
            anchors.append((ranges.stamp_ns[rows] / 1e9, driven[rows], limited - limited.mean()))
    return anchors


def print_drives(name: str, runs) -> None:
    half_squares, counts = np.zeros(len(DRIVEN_M) - 1), np.zeros(len(DRIVEN_M) - 1)
    variances, white, between = [], [], []
    for anchors in map(errors_by_anchor, runs):
        for number, (time_s, driven, error) in enumerate(anchors):
            variances.append(error.var())
            white.append((np.diff(error) ** 2).mean() / 2.0 / error.var())
            first, second = np.triu_indices(len(error), 1)
            values = (error[first] - error[second]) ** 2 / 2.0
            apart = np.abs(driven[first] - driven[second])
            half_squares += np.histogram(apart, DRIVEN_M, weights=values)[0]
            counts += np.histogram(apart, DRIVEN_M)[0]
            for other_s, _, other in anchors[number + 1 :]:
                between.append(np.corrcoef(error, np.interp(time_s, other_s, other))[0, 1])
    correlation = 1.0 - half_squares / counts / np.mean(variances)
    print(
        f"{name:22}{np.sqrt(np.mean(variances)):7.3f}{np.mean(white):7.2f}{np.mean(between):+9.2f}  ",
        *(f"{value:5.2f}" for value in correlation),
    )


def print_noise_at_rest(source) -> None:
    errors = {}
    for record in source:
        if record.truth:
            error = record.measurement.range_m - record.truth.range_m
            errors.setdefault(record.truth.configuration, []).append(error)
    deviations = [np.std(values) for values in errors.values()]
    print(
        f"{source.name}: standard deviation at rest, median of the placements {np.median(deviations):.3f} m"
    )


if __name__ == "__main__":
    data = Path(sys.argv[1])
    print_levels(data / "evk1000_apartment")
    print("\ndrives                     sd  white  anchors   correlation up to", *DRIVEN_M[1:], "m")
    sets = {}
    for source in real_runs(data)[0]:
        sets.setdefault((source.set_name, source.name.split("_")[0]), []).append(source.read())
    for names, runs in sets.items():
        print_drives(" ".join(dict.fromkeys(names)), runs)
    for kind in KINDS:
        drives = [Drive(seed, 1, 4, 60.0, kind) for seed in SEEDS]
        print_drives(f"{kind} (simulated)", [simulated_run(kind, "", drive) for drive in drives])
    print()
    print_noise_at_rest(DecaRangingFolder(data / "evk1000_apartment"))
    print_noise_at_rest(SimulatedBuildings(seed=1, placements=256, exchanges=20))
