"""Builds bare-metal Cortex-M4 images of the firmware with the GNU cross compiler."""

from __future__ import annotations

import enum
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
int main(void) {
    static uint32_t arena[4096];
    static uwb_cir cir;
    uwb_corrected corrected;
    return (int)uwb_correct(&uwb_model_data, uwb_range_m, &cir, arena, sizeof arena, &corrected);
}
"""


class Board(str, enum.Enum):
    """The boards that there is a start-up and a linker script for, in `firmware/boards/`."""

    QEMU_MPS2 = "qemu_mps2"
    QEMU_MPS2_LINK = "qemu_mps2_link"
    DWM1001C = "dwm1001c"


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
        static_bytes: variables.
    """

    elf: Path
    flash_bytes: int
    static_bytes: int


def missing_tools() -> list[str]:
    """The tools that building and emulating need and that are not installed."""
    tools = [f"{_PREFIX}{tool}" for tool in ("gcc", "size", "nm", "objdump")] + ["qemu-system-arm"]
    return [tool for tool in tools if shutil.which(tool) is None]


def require_tools() -> None:
    """Raise MissingDependencyError, with the line that installs them, where tools are missing."""
    missing = missing_tools()
    if missing:
        raise MissingDependencyError(f"{', '.join(missing)} not found", valid=APT)


def build_image(
    export: Path, build: Path, board: Board, kernels: Kernels = Kernels.CORTEX_M4, optimisation: str = "-Os"
) -> Image:
    """Build the board's program with the model in `export`, in the folder `build`.

    `-Os` is what Arduino uses; the kernels in assembly do not depend on it.

    Raises:
        MissingDependencyError: a tool is missing.
        UwbMitigationError: it does not compile, or does not fit the board.
    """
    folder = _boards_folder() / board.value
    return _link(export, build, board.value, sorted(folder.glob("*.c")), kernels, optimisation)


def measure_size(
    export: Path, build: Path, kernels: Kernels = Kernels.CORTEX_M4, optimisation: str = "-Os"
) -> Image:
    """Build a program that does nothing but correct a range: vectors, start-up, library, model."""
    stub = build / "size.c"
    stub.write_text(_SIZE_STUB, encoding="utf-8")
    return _link(export, build, Board.DWM1001C.value, [stub], kernels, optimisation, "size")


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
            *("-nostartfiles", "--specs=nano.specs", "-Wl,--gc-sections"),
            *("-T", str(script), "-o", str(elf), "-lm"),
        ]
    )
    lines = run([f"{_PREFIX}size", str(elf)]).splitlines()
    try:
        text, data, bss = (int(field) for field in lines[1].split()[:3])
    except (IndexError, ValueError) as error:
        raise UwbMitigationError(f"unexpected output of size: {lines!r}", where=str(elf)) from error
    return Image(elf, text + data, data + bss)
