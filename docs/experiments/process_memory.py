"""Write a bag of synthetic ranges in the current folder, process it, and print the peak memory.

Argument: the number of ranges. With 200,000 ranges the peak is 90 MiB at 10 % and 91 MiB at the end.
"""

import resource
import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.commands.offline.process import Job, process_bag
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record

count = int(sys.argv[1])
generator = np.random.default_rng(0)
level = np.repeat(150 + 3000 * np.exp(-np.abs(np.arange(157) - 6) / 8), 2)
cirs = [
    Cir(
        (generator.normal(0, 1, 314) * level).clip(-30000, 30000).astype(np.int16),
        first_path_index=5.5,
        preamble_count=300,
        rx_power_dbm=-82.0,
        first_path_power_dbm=-88.0,
        channel=2,
        prf_mhz=64,
    )
    for _ in range(2000)
]
with BagWriter(Path("synthetic.mcap"), {"source": "synthetic", "simulated": "true"}, force=True) as bag:
    for number in range(count):
        bag.write(
            Record(RangeMeasurement(10**18 + number * 10**6, 1, 2, number, 0, 4.5, cirs[number % 2000]))
        )

tenths = [0]


def report(done: int, total: int) -> None:
    if done * 10 >= total * (tenths[-1] + 1):
        tenths.append(done * 10 // total)
        print(f"{10 * tenths[-1]} %: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


outcome = process_bag(
    Job(Path("synthetic.mcap"), Path("corrected.mcap"), default_model_path(), force=True), report
)
print(f"{outcome.ranges} ranges, {outcome.ranges / outcome.seconds:.0f} ranges/s, {dict(outcome.statuses)}")
