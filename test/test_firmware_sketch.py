"""The Arduino sketch, compiled with a minimal replacement for the Arduino API."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

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
from uwb_mitigation.radios.wire.messages import Correction, Hello
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import RangeMeasurement

EXAMPLES = Path(__file__).parent.parent / "firmware" / "examples"
SKETCH = EXAMPLES / "UwbMitigation"
STUB = firmware_folder() / "test" / "arduino_stub"


def compile_sketch(name: str, folder: Path, compiler: tuple[str, ...], *files: str) -> Path:
    """Compile a sketch with the replacement and the model in `folder`, if any; return the program."""
    # Use the exported header; the committed one has a separate test.
    sketch, program = folder / f"{name}.cpp", folder / "sketch"
    sketch.write_text((EXAMPLES / name / f"{name}.ino").read_text())
    warnings = ("-Wall", "-Wextra", "-Werror", "-include", str(STUB / "Arduino.h"))
    includes = (f"-I{STUB}", f"-I{firmware_folder() / 'src'}", f"-I{MODEL_FOLDER}", f"-I{folder}")
    run_tool([*compiler, *warnings, *includes, str(sketch), *files, "-o", str(program)])
    return program


def test_sketch_contains_the_shipped_model(tmp_path: Path):
    export_bundle(load_bundle(default_model_path()), tmp_path)
    expected = (tmp_path / "uwb_model.h").read_text()
    assert (SKETCH / "uwb_model.h").read_text() == expected, f"uwb-mitigation board export-c -o {SKETCH}"


@NEEDS_CXX
def test_sketch_corrects_ranges_and_writes_blocks_that_are_safe_on_usb(tmp_path: Path):
    export_bundle(load_bundle(default_model_path()), tmp_path)
    files = (str(STUB / "main.cpp"), *library_objects(), "-lm")
    program = compile_sketch("UwbMitigation", tmp_path, ("c++", "-std=gnu++14", "-O1"), *files)
    encoder = FrameEncoder()
    wires = [encoder.encode(*messages.encode(r.measurement)) for r in SimulatedSource(seed=2, count=25)]
    done = subprocess.run(
        [program], input=b"".join(wires)[:60_000], capture_output=True, timeout=240, check=False
    )
    assert done.returncode == 0

    decoder, host = FrameDecoder(), Mitigation(load_bundle(default_model_path()))
    received = [messages.decode(frame.type, frame.payload) for frame in decoder.feed(done.stdout)]
    assert decoder.counts.corrupt == 0
    assert isinstance(received[0], Hello)
    corrections = [message for message in received if isinstance(message, Correction)]
    sent = [
        messages.decode(frame.type, frame.payload) for frame in FrameDecoder().feed(b"".join(wires)[:60_000])
    ]
    assert len(corrections) == len(sent) >= 10
    for measurement, correction in zip(sent, corrections, strict=True):
        assert isinstance(measurement, RangeMeasurement)
        expected = host.correct([measurement])[0]
        # Round to binary32 as on a board.
        wanted = Correction(
            0, correction.tag_id, correction.anchor_id, correction.sequence, correction.device_time,
            expected, correction.compute_us,
        )  # fmt: skip
        assert messages.encode(correction) == messages.encode(wanted)


@pytest.mark.skipif(shutil.which("arm-none-eabi-g++") is None, reason="apt install gcc-arm-none-eabi")
@pytest.mark.parametrize("name", ["UwbMitigation", "UwbRanger"])
def test_sketches_compile_for_the_boards_processor(tmp_path: Path, name: str):
    """Use the compiler options of the Arduino core for the nRF52840, without its headers."""
    export_bundle(load_bundle(default_model_path()), tmp_path)
    cpu = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=softfp", "-mfpu=fpv4-sp-d16")
    compile_sketch(name, tmp_path, ("arm-none-eabi-g++", *cpu, "-std=gnu++14", "-Os", "-c"))


@NEEDS_CXX
@pytest.mark.parametrize("with_model", [False, True], ids=["without a model", "with one"])
def test_sketch_with_a_radio_ranges_on_a_modelled_chip(tmp_path: Path, with_model: bool):
    if with_model:
        export_bundle(load_bundle(default_model_path()), tmp_path)
    files = (str(STUB / "radio_main.cpp"), *library_objects(), *model_objects(), "-lm", "-lpthread")
    program = compile_sketch("UwbRanger", tmp_path, ("c++", "-std=gnu++17", "-O1"), *files)
    done = subprocess.run([program, "0.5"], capture_output=True, timeout=240, check=False)

    assert done.returncode == 0
    decoder = FrameDecoder()
    received = [messages.decode(frame.type, frame.payload) for frame in decoder.feed(done.stdout)]
    assert decoder.counts.corrupt == 0
    hello = received[0]
    assert isinstance(hello, Hello)
    assert (hello.window == 157) is with_model
    ranges = [message for message in received if isinstance(message, RangeMeasurement)]
    assert len(ranges) > 50
    for measured in ranges:
        assert abs(measured.range_m - 7) < 0.02
        assert len(measured.cir) == 157
