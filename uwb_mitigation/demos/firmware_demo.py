"""`make firmware-demo`: the firmware in an emulated Cortex-M4 corrects, the driver publishes, the host compares.

python -m uwb_mitigation.entry firmware-demo [--recording PATH] [--count N]
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from diagnostic_msgs.msg import DiagnosticArray
from rich.console import Console
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.demos.base import Nodes, run_demo
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.firmware_export.emulated_firmware import EmulatedFirmware
from uwb_mitigation.link import messages as wire
from uwb_mitigation.measurement import CorrectedRange, Origin, RangeMeasurement
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.processes import Probe, watching
from uwb_mitigation.sources.opening import open_recording
from uwb_mitigation.sources.simulated import SimulatedSource

READY_TIMEOUT_S = 60.0
TIMEOUT_S = 60.0
"""After this time without a corrected range, the rest counts as lost."""


class BoardListener:
    """Keeps what the board corrected, and whether the driver has it in mode DEVICE."""

    def __init__(self, probe: Probe) -> None:
        self.ready = threading.Event()
        self.corrected: list[RangeCorrected] = []
        probe.subscribe(RangeCorrected, topics.RANGE_CORRECTED, self.corrected.append)
        probe.subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        facts = {value.key: value.value for status in message.status for value in status.values}
        if facts.get("mode") == "device":
            self.ready.set()


def numbered(recording: Path | None, count: int) -> list[RangeMeasurement]:
    """At most `count` measurements as a board holds them, in binary32, with sequences that tell them apart."""
    source = SimulatedSource(seed=1, count=count) if recording is None else open_recording(recording)
    with source:
        measured = [record.measurement for record in itertools.islice(source, count)]
    if not measured:
        raise UwbMitigationError("the recording holds no range", where=str(recording))
    held = []
    for sequence, measurement in enumerate(measured):
        kind, payload = wire.encode(measurement)
        decoded = wire.decode(kind, payload)
        assert isinstance(decoded, RangeMeasurement)
        held.append(replace(decoded, sequence=sequence))
    return held


def differences(expected: CorrectedRange, message: RangeCorrected) -> bool:
    """Whether board and host differ in any bit, or the message does not say that the board corrected."""
    values = [expected.range_m, expected.correction_m, expected.variance_m2]
    computed = [message.range, message.correction, message.variance]
    first, second = (np.array(row, np.float32).tobytes() for row in (values, computed))
    same = first == second and message.status == int(expected.status)
    return not (same and message.source == Origin.DEVICE and message.model_id == expected.model_id)


def play(
    board: EmulatedFirmware, listener: BoardListener, measured: Sequence[RangeMeasurement], console: Console
) -> None:
    """Measure with the board's radio, and wait until all has come back or nothing more does."""
    with console.status("waiting for the driver to bring the board into mode DEVICE") as status:

        def show() -> None:
            status.update(f"{len(listener.corrected)} of {len(measured)} ranges corrected")

        if not listener.ready.wait(READY_TIMEOUT_S):
            raise UwbMitigationError("the driver has not brought the board into mode DEVICE")
        for measurement in measured:
            board.measure(measurement)
            show()
        seen, since = -1, time.monotonic()
        while len(listener.corrected) < len(measured) and time.monotonic() - since < TIMEOUT_S:
            if len(listener.corrected) != seen:
                seen, since = len(listener.corrected), time.monotonic()
                show()
            time.sleep(0.05)


def summarise(
    console: Console,
    host: Mitigation,
    measured: Sequence[RangeMeasurement],
    received: Sequence[RangeCorrected],
) -> list[str]:
    """Print what came back; return the failures: ranges that are lost, doubled or not equal to the bit."""
    expected = host.correct(measured)
    arrived = {message.sequence: message for message in received}
    different = sum(
        differences(result, arrived[sequence])
        for sequence, result in enumerate(expected)
        if sequence in arrived
    )
    lost = len(measured) - len(arrived)
    counts = Counter(result.status.name for result in expected)
    statuses = ", ".join(f"{count} {name}" for name, count in counts.items())
    console.print(f"{len(measured)} ranges measured, {len(arrived)} corrected by the board, {lost} lost")
    console.print(
        f"{len(arrived) - different} equal to the host's to the bit, {different} different ({statuses})"
    )
    good = not lost and not different and len(received) == len(arrived)
    return [] if good else ["board and host differ"]


def run(console: Console, measured: Sequence[RangeMeasurement]) -> list[str]:
    """Start board and driver, play, compare; return the failures."""
    bundle = load_bundle(default_model_path())
    console.print(f"building the firmware with model {bundle.name}, id {bundle.model_id:08x}")
    with EmulatedFirmware(bundle) as board, watching(Probe) as probe:
        console.print(f"emulated Cortex-M4 on {board.port}")
        listener = BoardListener(probe)
        with Nodes() as nodes:
            nodes.start("driver", "source:=serial", f"port:={board.port}", "mode:=device")
            play(board, listener, measured, console)
    return nodes.failures + summarise(console, Mitigation(bundle), measured, listener.corrected)


def firmware_demo(
    recording: Annotated[
        Path | None,
        typer.Option(help="DecaRanging log, folder of logs, or MCAP bag. Default: a simulated recording."),
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="Ranges to measure, at most.")] = 200,
) -> None:
    """Run the firmware in an emulator as a board of the driver, and compare its ranges with the host's."""
    raise typer.Exit(run_demo("firmware-demo", lambda console: run(console, numbered(recording, count))))


def main() -> None:
    typer.run(firmware_demo)
