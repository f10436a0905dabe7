"""The Arduino sketches, compiled with a replacement for the Arduino core that runs on emulated time."""

import itertools
import math
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest
from compilers import NEEDS_CXX

from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER, model_objects
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded.compiled import library_objects
from uwb_mitigation.mitigation.embedded.compiling import firmware_folder, run_tool
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, FrameEncoder
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Hello, Log
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import RangeMeasurement

pytestmark = NEEDS_CXX

T = TypeVar("T")

QUICK = ("-O1",)

EXAMPLES = Path(__file__).parent.parent / "firmware" / "examples"
SKETCH = EXAMPLES / "UwbMitigation"
STUB = firmware_folder() / "test" / "arduino_stub"
CORRECTION_US = 6500
"""Estimate for K = 157 at 64 MHz: 412,570 cycles."""


def compile_sketch(name: str, folder: Path, standard: str, *files: str) -> Path:
    """Compile a sketch with the replacement and the model in `folder`, if any; return the program."""
    # Use the exported header; the committed one has a separate test.
    sketch, program = folder / f"{name}.cpp", folder / "sketch"
    sketch.write_text((EXAMPLES / name / f"{name}.ino").read_text())
    options = (f"-std={standard}", "-O1", "-funsigned-char", "-Wall", "-Wextra", "-Werror", "-no-pie")
    includes = (f"-I{STUB}", f"-I{firmware_folder() / 'src'}", f"-I{MODEL_FOLDER}", f"-I{folder}")
    stub = ("-include", str(STUB / "Arduino.h"), str(STUB / "core.cpp"))
    run_tool(["c++", *options, *includes, *stub, str(sketch), *files, "-o", str(program)])
    return program


def test_sketch_contains_the_shipped_model(tmp_path: Path):
    export_bundle(load_bundle(default_model_path()), tmp_path)
    expected = (tmp_path / "uwb_model.h").read_text()
    assert (SKETCH / "uwb_model.h").read_text() == expected, f"uwb-mitigation board export-c -o {SKETCH}"


@pytest.fixture(scope="module")
def mitigation_sketch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sketch")
    export_bundle(load_bundle(default_model_path()), folder)
    files = (str(STUB / "main.cpp"), *library_objects(QUICK), "-Wl,--wrap=uwb_network", "-lm")
    return compile_sketch("UwbMitigation", folder, "gnu++14", *files)


@pytest.fixture(scope="module")
def measurements() -> list[RangeMeasurement]:
    """Return measurements with 157 complex samples."""
    shortened = []
    for record in SimulatedSource(seed=2, count=40):
        measurement = record.measurement
        cir = measurement.cir
        start = math.floor(cir.first_path_index) - 5 - cir.start_index
        samples = cir.samples[2 * start : 2 * (start + 157)]
        window = replace(cir, samples=samples, start_index=cir.start_index + start)
        shortened.append(replace(measurement, cir=window))
    return shortened


def run_mitigation(
    sketch: Path,
    folder: Path,
    measurements: Sequence[RangeMeasurement],
    count: int,
    *arguments: object,
    upload_s: float = 0,
) -> list[list[object]]:
    """Send `count` measurements to the sketch and run it, see main.cpp; return the messages of every session.

    No frame may be torn.
    """
    encoder = FrameEncoder()
    sent = (messages.encode(m) for m in itertools.islice(itertools.cycle(measurements), count))
    wire = b"".join(encoder.encode(*message) for message in sent)
    command = [sketch, f"{folder}/session", *map(str, arguments), str(upload_s)]
    done = subprocess.run(command, input=wire, capture_output=True, timeout=240, check=False)
    assert done.returncode == 0
    return [received_messages(path.read_bytes()) for path in sorted(folder.glob("session*"))]


def received_messages(stream: bytes) -> list[object]:
    """Decode a session from its start, without a damaged frame except an incomplete last one."""
    assert stream[:1] == b"\0", "a session starts with a complete frame"
    decoder = FrameDecoder()
    received: list[object] = [messages.decode(frame.type, frame.payload) for frame in decoder.feed(stream)]
    assert decoder.corrupt == 0
    return received


def of_type(kind: type[T], received: list[object]) -> list[T]:
    return [message for message in received if isinstance(message, kind)]


def test_sketch_corrects_each_measurement_that_arrives_back_to_back(
    tmp_path: Path, mitigation_sketch: Path, measurements: list[RangeMeasurement]
):
    """At 921,600 baud, while a correction takes longer than a half of the receive buffer lasts."""
    arguments = ("reads", 0, 0, 0, CORRECTION_US, 1.8)
    (received,) = run_mitigation(mitigation_sketch, tmp_path, measurements, 80, *arguments)

    assert isinstance(received[0], Hello)
    corrections = of_type(Correction, received)
    status = of_type(BoardStatus, received)[-1]
    assert status.measurements == len(corrections) == 80
    assert status.measurements_lost == 0
    assert not of_type(Log, received)
    host = Mitigation(load_bundle(default_model_path()))
    for measurement, correction in zip(itertools.cycle(measurements), corrections, strict=False):
        # Round to binary32 as on a board.
        expected = host.correct([messages.decode(*messages.encode(measurement))])[0]
        assert messages.encode(correction) == messages.encode(replace(correction, corrected=expected))


def test_sketch_counts_what_it_drops_if_the_radio_is_faster(
    tmp_path: Path, mitigation_sketch: Path, measurements: list[RangeMeasurement]
):
    arguments = ("reads", 0, 0, 0, 50_000, 8.5)
    (received,) = run_mitigation(mitigation_sketch, tmp_path, measurements, 150, *arguments)

    status = of_type(BoardStatus, received)[-1]
    corrections = of_type(Correction, received)
    assert status.measurements == 150
    assert 0 < status.measurements_lost == 150 - len(corrections)
    assert not of_type(Log, received), "complete frames are dropped: none is damaged"


def test_next_sketch_can_be_uploaded_while_the_watchdog_runs(tmp_path: Path, mitigation_sketch: Path):
    """A started watchdog runs on during the reset into the boot loader, which does not feed it."""
    run_mitigation(mitigation_sketch, tmp_path, [], 0, "reads", 0, 0, 0, 0, 0.2, upload_s=45)


@pytest.mark.parametrize("host", ["silent", "closed"])
def test_sketch_survives_a_host_that_does_not_read_for_10_s(
    tmp_path: Path, mitigation_sketch: Path, measurements: list[RangeMeasurement], host: str
):
    """Either the port stays open and nobody reads, or it is closed and opened again."""
    arguments = (host, 1.0037, 11, 20_000, CORRECTION_US, 17)
    sessions = run_mitigation(mitigation_sketch, tmp_path, measurements, 500, *arguments)

    assert len(sessions) == (2 if host == "closed" else 1)
    received = [message for session in sessions for message in session]
    status = of_type(BoardStatus, received)[-1]
    assert status.measurements == 500
    lost = 500 - len(of_type(Correction, received))
    assert status.measurements_lost > 0, "the queue must overflow, or the test shows nothing"
    # The last frame before the port was closed may be lost in transfer.
    assert lost - status.measurements_lost in ((0,) if host == "silent" else (0, 1))


@pytest.fixture(scope="module", params=[False, True], ids=["without a model", "with one"])
def radio_sketch(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, bool]:
    """Return UwbRanger, compiled, and whether it has a model."""
    folder = tmp_path_factory.mktemp("radio")
    if request.param:
        export_bundle(load_bundle(default_model_path()), folder)
    files = (str(STUB / "radio_main.cpp"), *library_objects(QUICK), *model_objects(), "-lm", "-lpthread")
    return compile_sketch("UwbRanger", folder, "gnu++17", *files), request.param


@pytest.mark.parametrize("host", ["reads", "silent", "closed"])
def test_sketch_with_a_radio_ranges_on_a_modelled_chip(
    tmp_path: Path, radio_sketch: tuple[Path, bool], host: str
):
    program, with_model = radio_sketch
    command = [program, f"{tmp_path}/session", host, "0.2", "10.2", "10.5"]
    done = subprocess.run(command, capture_output=True, timeout=240, check=False)

    assert done.returncode == 0
    sessions = [received_messages(path.read_bytes()) for path in sorted(tmp_path.glob("session*"))]
    assert len(sessions) == (2 if host == "closed" else 1)
    status = of_type(BoardStatus, sessions[-1])[-1]
    assert status.measurements > 300, "it ranges on while the host does not read"
    assert (status.measurements_lost > 0) is (host != "reads")
    assert (sessions[0][0].window == 157) is with_model
    ranges = [message for session in sessions for message in of_type(RangeMeasurement, session)]
    assert len(ranges) > 40
    for measured in ranges:
        assert abs(measured.range_m - 7) < 0.02
        assert len(measured.cir) == 157
