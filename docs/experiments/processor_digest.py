"""Print a digest of all corrected ranges of the shipped models. Two processors with equal lines give equal bits.

    python docs/experiments/processor_digest.py RECORDING...

Run it on both processors with the same recordings and compare the lines. It needs only the packages in
`requirements/lock.txt`. Simulate a recording once and copy it, because the simulator uses functions (exp, log) that differ
between processors. An aarch64 system can be emulated: unpack the arm64 packages of Python with `dpkg -x`, add the wheels
(`pip download --platform manylinux_2_28_aarch64 --only-binary=:all:`) and `qemu-aarch64-static`, and use `chroot`.
"""

from __future__ import annotations

import hashlib
import platform
import sys
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import SHIPPED, shipped_model_path
from uwb_mitigation.recordings.formats import open_recording


def main(recordings: list[Path]) -> None:
    print(platform.machine(), file=sys.stderr)
    for recording in recordings:
        with open_recording(recording) as source:
            measurements = [record.measurement for record in source]
        for name in SHIPPED:
            bundle = load_bundle(shipped_model_path(name))
            corrected = Mitigation(bundle).correct(measurements)
            rows = np.array([(row.range_m, row.variance_m2, row.status.value) for row in corrected], float)
            digest = hashlib.sha256(rows.astype("<f8").tobytes()).hexdigest()[:16]
            print(f"{recording.name}: {name} {bundle.model_id:08x}: {len(rows)} ranges, {digest}")


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
