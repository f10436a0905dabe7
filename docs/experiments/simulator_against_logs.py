"""Compare the distributions of simulated and real ranges: error, levels, preamble count, threshold, peak.

Arguments: the folder of the EVK1000 logs, and the number of simulated ranges (6000).

A linear bias model that is fitted to the real logs lowers the MAE of the simulated drive from 0.539 m to 0.336 m. More of the
simulated NLOS ranges are weak, and the detection threshold of the chip is up to three times higher on strong signals than in the simulator.
"""

import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.recordings.decaranging import DecaRangingFolder
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias

count = int(sys.argv[2]) if len(sys.argv) > 2 else 6000
line = None
for source in (DecaRangingFolder(Path(sys.argv[1])), SimulatedSource(seed=1, count=count)):
    rows = []
    for record in source:
        m, truth = record.measurement, record.truth
        rx, gap = m.cir.rx_power_dbm, m.cir.rx_power_dbm - m.cir.first_path_power_dbm
        if truth and np.isfinite([rx, gap]).all():
            taps = m.cir.samples.reshape(-1, 2).astype(float)
            peak = np.sqrt(np.hypot(*taps.T).max() / 60 / m.cir.preamble_count)
            error = m.range_m - truth.range_m
            radio = (rx, gap, m.cir.preamble_count, m.cir.noise_threshold, peak)
            rows.append((truth.label, truth.configuration, error, *radio))
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
