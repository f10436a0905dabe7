"""Library and sketches, compiled with the flags of the Arduino core for the nRF52840 and linked with `ld -r`."""

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from uwb_mitigation.mitigation.embedded.compiling import WARNINGS, compile_objects, firmware_folder, run_tool
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path

pytestmark = pytest.mark.skipif(
    shutil.which("arm-none-eabi-g++") is None, reason="apt install gcc-arm-none-eabi"
)
SOURCES = firmware_folder() / "src"
_STEPS = ("quantise", "conv_first", "conv_residual", "conv_reduce_odd", "conv_reduce_even", "dense", "dot")
KERNELS = {f"uwb_{step}" for step in _STEPS}

# ArduinoCore-mbed, variant ARDUINO_NANO33BLE: platform.txt and cflags.txt. The assembler gets no -mfloat-abi.
FPU = "-mfpu=fpv4-sp-d16"
SOFTFP = ("-mfloat-abi=softfp", FPU)
COMMON = ("-c", "-Os", "-funsigned-char", "-mcpu=cortex-m4", "-mthumb", "-ffunction-sections", "-fdata-sections",
          "-nostdlib", "-fno-exceptions", "-fomit-frame-pointer", "-Wall", "-Wextra")  # fmt: skip
C = ("arm-none-eabi-gcc", "-std=gnu11", *COMMON)
ASSEMBLER = ("arm-none-eabi-g++", "-c", "-x", "assembler-with-cpp", "-mcpu=cortex-m4")


CXX = ("arm-none-eabi-g++", "-std=gnu++14", "-fno-rtti", "-Wvla", *COMMON, *SOFTFP)

STUB = firmware_folder() / "test" / "arduino_stub"


def compile_each(compiler: tuple[str, ...], pattern: str = "*.c") -> tuple[str, ...]:
    """Compile each source of the library, once for all tests with the same flags; return the object files."""
    return compile_objects(compiler[:1], compiler[1:], tuple(sorted(SOURCES.rglob(pattern))))


def symbols(kind: str, *objects: str) -> set[str]:
    """Return the symbols of a kind: U undefined, T global functions."""
    listed = run_tool(["arm-none-eabi-nm", *objects]).splitlines()
    return {line.split()[-1] for line in listed if f" {kind} " in line}


def undefined_symbols(objects: Sequence[str], folder: Path) -> set[str]:
    """Link with `ld -r`; return the undefined symbols."""
    linked = str(folder / "linked.o")
    run_tool(["arm-none-eabi-ld", "-r", *objects, "-o", linked])
    return symbols("U", linked)


@pytest.mark.parametrize("name", ["UwbMitigation", "UwbRanger"])
def test_sketch_and_library_link_with_the_flags_of_the_core(tmp_path: Path, name: str):
    """The symbols of the core, which the stub only declares, stay undefined."""
    export_bundle(load_bundle(default_model_path()), tmp_path)
    sketch = tmp_path / f"{name}.cpp"
    sketch.write_text((firmware_folder() / "examples" / name / f"{name}.ino").read_text())
    includes = (f"-I{STUB}", f"-I{SOURCES}", "-include", str(STUB / "Arduino.h"))
    run_tool([*CXX, *includes, str(sketch)], folder=tmp_path)
    objects = (
        str(sketch.with_suffix(".o")),
        *compile_each((*C, *SOFTFP)),
        *compile_each((*ASSEMBLER, FPU), "*.S"),
    )
    undefined = undefined_symbols(objects, tmp_path)
    assert not {symbol for symbol in undefined if symbol.startswith("uwb_")}
    assert any("send_nb" in symbol for symbol in undefined), "the compiler removed the sending"


def test_library_properties_follow_the_rules_of_the_library_manager():
    """Rules LP of arduino-lint, of the fields that change. That `url` is reachable is not tested."""
    lines = (firmware_folder() / "library.properties").read_text().splitlines()
    fields = dict(line.split("=", 1) for line in lines)
    assert {"name", "author", "maintainer", "sentence", "paragraph", "category", "architectures"} <= set(
        fields
    )
    assert re.fullmatch(r"\d+\.\d+\.\d+", fields["version"])
    package = (firmware_folder().parent / "package.xml").read_text()
    assert f'<url type="repository">{fields["url"]}</url>' in package
    assert all((SOURCES / header).is_file() for header in fields["includes"].split(","))
    licences = [folder / "LICENSE" for folder in (firmware_folder(), firmware_folder().parent)]
    assert licences[0].read_bytes() == licences[1].read_bytes()


C_VARIANTS = [SOFTFP, ("-mfloat-abi=hard", FPU), ("-mfloat-abi=soft",), (*SOFTFP, "-DUWB_PORTABLE")]
_THUMB = ("-mthumb", "-mfloat-abi=hard", FPU), ("-mthumb", "-mfloat-abi=soft")
ASSEMBLER_VARIANTS = [(FPU,), (), *_THUMB, (FPU, "-DUWB_PORTABLE")]


@pytest.mark.parametrize("c_flags", C_VARIANTS, ids=lambda flags: " ".join(flags))
def test_c_and_assembler_agree_for_every_combination_of_flags(tmp_path: Path, c_flags: tuple[str, ...]):
    # The files that choose kernels; the optimisation does not matter.
    c = compile_each((*C, *c_flags, "-O0"), "uwb_[cknp]*.c")
    portable = "-DUWB_PORTABLE" in c_flags or "-mfloat-abi=soft" in c_flags
    # The portable kernels are in the C objects exactly if the assembler kernels are not used.
    assert KERNELS & symbols("T", *c) == (KERNELS if portable else set())
    for assembler_flags in ASSEMBLER_VARIANTS:
        undefined = undefined_symbols(c + compile_each((*ASSEMBLER, *assembler_flags), "*.S"), tmp_path)
        assert not {name for name in undefined if name.startswith("uwb_")}, assembler_flags


@pytest.mark.parametrize("cpu", ["cortex-m0", "cortex-m3", "cortex-m7", "cortex-m33"])
def test_library_links_without_warnings_for_other_processors(tmp_path: Path, cpu: str):
    objects = compile_each((*C, *WARNINGS, "-O0", f"-mcpu={cpu}"))
    objects += compile_each((*ASSEMBLER, f"-mcpu={cpu}"), "*.S")
    assert not {name for name in undefined_symbols(objects, tmp_path) if name.startswith("uwb_")}
