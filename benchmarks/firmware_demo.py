"""`make firmware-demo`: the firmware in an emulated Cortex-M4 corrects, the driver publishes, the host compares.

python -m benchmarks firmware-demo [--recording PATH] [--count N]
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rich.console import Console
from uwb_mitigation_msgs.msg import RangeCorrected

from benchmarks.equipment.emulated_firmware import EmulatedFirmware
from benchmarks.equipment.probe import Probe
from benchmarks.equipment.processes import NodeProcesses, run_demo
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.radios.wire import messages as wire
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, RangeMeasurement
from uwb_mitigation.types.ros import topics

TIMEOUT_S = 60.0
"""Timeout for mode DEVICE and for the next corrected range; after it, the remaining ranges count as lost."""


def read_measurements(recording: Path | None, count: int) -> list[RangeMeasurement]:
    """Return at most `count` measurements in binary32, as on a board, with unique sequence numbers."""
    source = SimulatedSource(seed=1, count=count) if recording is None else open_recording(recording)
    with source:
        measured = [record.measurement for record in itertools.islice(source, count)]
    if not measured:
        raise UwbMitigationError("the recording contains no ranges", where=str(recording))
    measurements = []
    for sequence, measurement in enumerate(measured):
        kind, payload = wire.encode(measurement)
        decoded = wire.decode(kind, payload)
        assert isinstance(decoded, RangeMeasurement)
        measurements.append(replace(decoded, sequence=sequence))
    return measurements


def is_identical(expected: CorrectedRange, message: RangeCorrected) -> bool:
    """Return whether a range corrected by the board is bit-identical to that of the host."""
    values = (expected.range_m, expected.correction_m, expected.variance_m2)
    computed = (message.range, message.correction, message.variance)
    first, second = (np.array(row, np.float32).tobytes() for row in (values, computed))
    same_origin = message.source == CorrectedBy.DEVICE and message.model_id == expected.model_id
    return first == second and message.status == int(expected.status) and same_origin


def run(console: Console, measured: Sequence[RangeMeasurement]) -> list[str]:
    """Start board and driver, measure with the board's radio, and compare; return the failures."""
    bundle = load_bundle(default_model_path())
    console.print(f"building the firmware with model {bundle.name}, id {bundle.model_id:08x}")
    corrected: list[RangeCorrected] = []
    ready = threading.Event()

    def on_diagnostics(message: DiagnosticArray) -> None:
        if any(v.key == "mode" and v.value == "device" for status in message.status for v in status.values):
            ready.set()

    with EmulatedFirmware(bundle) as board, spinning_node(Probe) as probe:
        console.print(f"emulated Cortex-M4 on {board.port}")
        probe.subscribe(RangeCorrected, topics.RANGE_CORRECTED, corrected.append)
        probe.subscribe(DiagnosticArray, topics.DIAGNOSTICS, on_diagnostics)
        with NodeProcesses() as nodes, console.status("waiting for the corrected ranges"):
            nodes.start("driver", "source:=serial", f"port:={board.port}", "mode:=device")
            if not ready.wait(TIMEOUT_S):
                raise UwbMitigationError("the board did not change to mode DEVICE")
            for measurement in measured:
                board.measure(measurement)
            seen, since_s = -1, time.monotonic()
            while len(corrected) < len(measured) and time.monotonic() - since_s < TIMEOUT_S:
                if len(corrected) != seen:
                    seen, since_s = len(corrected), time.monotonic()
                time.sleep(0.05)
    expected = Mitigation(bundle).correct(measured)
    arrived = {message.sequence: message for message in corrected}
    equal = sum(is_identical(expected[sequence], message) for sequence, message in arrived.items())
    lost, different = len(measured) - len(arrived), len(arrived) - equal
    statuses = Counter(result.status.name for result in expected)
    shown = ", ".join(f"{count} {name}" for name, count in statuses.items())
    console.print(f"{len(measured)} ranges measured, {len(arrived)} corrected by the board, {lost} lost")
    console.print(f"{equal} bit-identical to those of the host, {different} different ({shown})")
    if lost or different or len(corrected) != len(arrived):
        nodes.failures.append("the corrections of board and host differ")
    return nodes.failures


def main(recording: Path | None, count: int) -> int:
    """Run the demonstration and return its exit code."""
    return run_demo("firmware-demo", lambda console: run(console, read_measurements(recording, count)))
