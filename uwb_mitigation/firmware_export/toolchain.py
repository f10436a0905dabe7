"""Builds bare-metal Cortex-M4 images of the firmware with the GNU cross compiler."""

from __future__ import annotations

import enum
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError, UwbMitigationError
from uwb_mitigation.firmware_export.compiling import WARNINGS, compile_objects, firmware_folder, run

APT = "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"

_PREFIX = "arm-none-eabi-"
_CPU = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
# GNU C11 as Arduino builds: there the compiler may fuse float operations that the sources must prevent.
_COMMON = ("-std=gnu11", "-g0", "-ffunction-sections", "-fdata-sections", "-fno-math-errno")

_WARNINGS = tuple(flag for flag in WARNINGS if flag != "-Wpedantic")

_SIZE_STUB = """\
#include "uwb_model.h"
void board_exit(int code);
void board_exit(int code) { (void)code; for (;;) { } }
volatile float uwb_range_m;
volatile float uwb_offset_m;
int main(void) {
    static uint32_t arena[4096];
    static uwb_cir cir;
    uwb_corrected corrected;
    return (int)uwb_correct(&uwb_model_data, uwb_range_m, uwb_offset_m, &cir, arena, sizeof arena, &corrected);
}
"""


class Target(str, enum.Enum):
    """The boards that there is a start-up and a linker script for, in `firmware/boards/`."""

    QEMU_MPS2 = "qemu_mps2"
    QEMU_MPS2_LINK = "qemu_mps2_link"
    QEMU_MPS2_RADIO = "qemu_mps2_radio"
    DWM1001C = "dwm1001c"
    DWM1001_DEV = "dwm1001_dev"


class Kernels(str, enum.Enum):
    """Which implementation of the layers an image holds."""

    CORTEX_M4 = "cortex_m4"
    PORTABLE = "portable"


@dataclass(frozen=True, slots=True)
class Image:
    """A linked image.

    Attributes:
        elf: its file.
        flash_bytes: code, constants and initial values of variables.
        static_bytes: variables; what they leave of the RAM is the stack's.
        flash_room, ram_room: what the board has, bytes.
    """

    elf: Path
    flash_bytes: int
    static_bytes: int
    flash_room: int
    ram_room: int


def missing_tools() -> list[str]:
    """The tools that building and emulating need and that are not installed."""
    tools = [f"{_PREFIX}{tool}" for tool in ("gcc", "nm", "objcopy", "objdump")] + ["qemu-system-arm"]
    return [tool for tool in tools if shutil.which(tool) is None]


def require_tools() -> None:
    """Raise MissingDependencyError, with the line that installs them, where tools are missing."""
    missing = missing_tools()
    if missing:
        raise MissingDependencyError(f"{', '.join(missing)} not found", valid=APT)


def build_image(
    export: Path, build: Path, board: Target, kernels: Kernels = Kernels.CORTEX_M4, optimisation: str = "-Os"
) -> Image:
    """Build the board's program with the model in `export`, in the folder `build`.

    `-Os` is what Arduino uses; the kernels in assembly do not depend on it.

    Raises:
        MissingDependencyError: a tool is missing.
        UwbMitigationError: it does not compile, or does not fit the board.
    """
    folder = _boards_folder() / board.value
    return _link(export, build, board.value, sorted(folder.glob("*.c")), kernels, optimisation)


def write_hex(image: Image, output: Path) -> None:
    """Write an image as Intel HEX, which a J-Link's drive takes."""
    run([f"{_PREFIX}objcopy", "-O", "ihex", str(image.elf), str(output)])


def measure_size(
    export: Path, build: Path, kernels: Kernels = Kernels.CORTEX_M4, optimisation: str = "-Os"
) -> Image:
    """Build a program that does nothing but correct a range: vectors, start-up, library, model."""
    stub = build / "size.c"
    stub.write_text(_SIZE_STUB, encoding="utf-8")
    return _link(export, build, Target.DWM1001C.value, [stub], kernels, optimisation, "size")


def _boards_folder() -> Path:
    folder = firmware_folder() / "boards"
    if not folder.is_dir():
        raise MissingDependencyError(
            "the firmware's boards are not installed", where=str(folder), valid="run from a source checkout"
        )
    return folder


def _link(
    export: Path,
    build: Path,
    board: str,
    sources: Sequence[Path],
    kernels: Kernels,
    optimisation: str,
    name: str = "",
) -> Image:
    require_tools()
    library, boards = firmware_folder() / "src", _boards_folder()
    (script,) = (boards / board).glob("*.ld")
    elf = build / f"{name or board}_{kernels.value}.elf"
    portable = ("-DUWB_PORTABLE",) if kernels is Kernels.PORTABLE else ()
    options = (*_CPU, *_COMMON, optimisation, *_WARNINGS, *portable, f"-I{library}")
    layers = (*library.glob("*.c"), *(library / "cortex_m4").glob("*.S"), boards / "cortex_m4" / "startup.c")
    objects = compile_objects((f"{_PREFIX}gcc",), options, tuple(sorted(layers)))
    run(
        [
            f"{_PREFIX}gcc",
            *options,
            f"-I{export}",
            f"-L{boards / 'cortex_m4'}",
            *map(str, sources),
            *objects,
            *(
                "-nostartfiles",
                "--specs=nano.specs",
                "-Wl,--gc-sections",
                f"-Wl,-Map={elf.with_suffix('.map')}",
            ),
            *("-T", str(script), "-o", str(elf), "-lm"),
        ]
    )
    return _measured(elf)


_REGION = re.compile(r"^(FLASH|RAM) +0x([0-9a-f]+) +0x([0-9a-f]+)", re.MULTILINE)
# A long name stands in a line of its own.
_SECTION = re.compile(
    r"^(\.\S+)\s+0x([0-9a-f]+)\s+0x([0-9a-f]+)(?: load address 0x([0-9a-f]+))?$", re.MULTILINE
)


def _measured(elf: Path) -> Image:
    """What the linker's map says of memory: how far flash and RAM are taken."""
    text = elf.with_suffix(".map").read_text(encoding="utf-8")
    regions = {name: (int(origin, 16), int(length, 16)) for name, origin, length in _REGION.findall(text)}
    sections = {
        name: (int(address, 16), int(size, 16), int(load or address, 16))
        for name, address, size, load in _SECTION.findall(text)
    }
    try:
        (flash, flash_room), (ram, ram_room) = regions["FLASH"], regions["RAM"]
        _, data_bytes, data_load = sections[".data"]
        bss, bss_bytes, _ = sections[".bss"]
    except KeyError as error:
        raise UwbMitigationError(f"the linker's map lacks {error}", where=str(elf)) from error
    # Initial values of variables are the last in flash, variables without one the last in RAM.
    return Image(elf, data_load + data_bytes - flash, bss + bss_bytes - ram, flash_room, ram_room)
