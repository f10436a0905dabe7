"""Measure the time of the Python interface for each CIR, on one core; medians of five runs in turn.

python docs/experiments/python_speed.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from uwb_mitigation import Encoding, Mitigation, load_model
from uwb_mitigation.simulation.simulated import SimulatedSource

RANGES, TAPS, BEFORE = 1024, 400, 180
"""The arrays contain 400 of 1016 samples, which are all that a correction reads."""

records = list(SimulatedSource(seed=1, count=RANGES))
measurements = [record.measurement for record in records]
cirs = [measurement.cir for measurement in measurements]
assert all(cir.encoding is Encoding.COMPLEX_INT16 for cir in cirs)
starts = [int(cir.first_path_index) - BEFORE for cir in cirs]
pairs = np.stack([cir.samples.reshape(-1, 2)[start:][:TAPS] for cir, start in zip(cirs, starts, strict=True)])
fields = {
    name: [getattr(cir, name) for cir in cirs]
    for name in ("first_path_index", "preamble_count", "rx_power_dbm", "first_path_power_dbm")
}
arrays = {
    "range_m": [measurement.range_m for measurement in measurements],
    "cir": pairs[..., 0] + 1j * pairs[..., 1],
}
mitigation = Mitigation(load_model())
WAYS: dict[str, Callable[[], object]] = {
    "correct(measurement)": lambda: [mitigation.correct(measurement) for measurement in measurements],
    "correct(list of 64)": lambda: [
        mitigation.correct(measurements[i : i + 64]) for i in range(0, RANGES, 64)
    ],
    "correct(list)": lambda: mitigation.correct(measurements),
    "correct_records": lambda: list(mitigation.correct_records(records)),
    "correct_arrays": lambda: mitigation.correct_arrays(**arrays, **fields, start_index=starts),
}

if __name__ == "__main__":
    times = dict[str, list[float]]({name: [] for name in WAYS})
    for _ in range(5):
        for name, way in WAYS.items():
            started = time.process_time()
            way()
            times[name].append((time.process_time() - started) / RANGES * 1e6)
    for name, values in times.items():
        print(f"{name:22} {np.median(values):5.0f} us")
