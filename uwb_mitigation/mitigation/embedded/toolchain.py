"""Build bare-metal Cortex-M4 images of the firmware with the GNU cross compiler."""

from __future__ import annotations

import enum
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.mitigation.embedded import compiling

APT = "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"

_PREFIX = "arm-none-eabi-"
_CPU = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
# GNU C11 as in Arduino builds: in this mode the compiler may fuse float operations unless the sources prevent it.
_COMMON = ("-std=gnu11", "-g0", "-ffunction-sections", "-fdata-sections", "-fno-math-errno")

_UNIT_SHIFTS = {"B": 0, "KB": 10, "MB": 20, "GB": 30}

_WARNINGS = tuple(flag for flag in compiling.WARNINGS if flag != "-Wpedantic")


class Target(str, enum.Enum):
    """Boards with start-up code and a linker script in `firmware/boards/`."""

    QEMU_MPS2 = "qemu_mps2"
    QEMU_MPS2_LINK = "qemu_mps2_link"
    DWM1001_DEV = "dwm1001_dev"


_SOURCES = {
    Target.QEMU_MPS2: compiling.CORRECTION,
    Target.QEMU_MPS2_LINK: compiling.BOARD,
    Target.DWM1001_DEV: "*.c",
}


class Kernels(str, enum.Enum):
    """Implementation of the layers in an image."""

    CORTEX_M4 = "cortex_m4"
    PORTABLE = "portable"


@dataclass(frozen=True, slots=True)
class Image:
    """A linked image.

    Attributes:
        elf: path of the image.
        flash_bytes: code, constants and initial values of variables.
        static_bytes: variables; the rest of the RAM is the stack.
        available_flash_bytes, available_ram_bytes: flash and RAM of the board.
    """

    elf: Path
    flash_bytes: int
    static_bytes: int
    available_flash_bytes: int
    available_ram_bytes: int


def missing_tools() -> list[str]:
    """Return the missing tools for building and emulating images."""
    tools = [f"{_PREFIX}{tool}" for tool in ("gcc", "nm", "objcopy", "objdump")] + ["qemu-system-arm"]
    return [tool for tool in tools if shutil.which(tool) is None]


def require_tools() -> None:
    """Raise MissingDependencyError, with the command that installs them, if tools are missing."""
    missing = missing_tools()
    if missing:
        raise MissingDependencyError(f"{', '.join(missing)} not found", valid=APT)


def compile_image(
    export: Path,
    build: Path,
    board: Target,
    kernels: Kernels = Kernels.CORTEX_M4,
    program: Path | None = None,
) -> Image:
    """Build the board's program, or another `program`, with the model in `export`, in the folder `build`.

    Arduino builds with `-Os`; the assembly kernels do not depend on the optimisation level. Portable ones are built with `-O3`.

    Raises:
        MissingDependencyError: a tool is missing, or this is not a source checkout.
        UwbMitigationError: the compilation fails, or the image does not fit the board.
    """
    require_tools()
    library, boards = compiling.firmware_folder() / "src", compiling.firmware_folder() / "boards"
    if not boards.is_dir():
        raise MissingDependencyError(
            "the boards of the firmware are not installed",
            where=boards,
            valid="in a checkout: python3 -m uwb_mitigation.commands.cli board build-image",
        )
    common = boards / "cortex_m4"
    elf = build / f"{program.stem if program else board.value}_{kernels.value}.elf"
    kind = ("-O3", "-DUWB_PORTABLE") if kernels is Kernels.PORTABLE else ("-Os",)
    options = (*_CPU, *_COMMON, *kind, *_WARNINGS, f"-I{library}")
    layers = (*library.glob(_SOURCES[board]), *(library / "cortex_m4").glob("*.S"), common / "startup.c")
    objects = compiling.compile_objects((f"{_PREFIX}gcc",), options, tuple(sorted(layers)))
    sources = [program] if program else sorted((boards / board.value).glob("*.c"))
    script = common / ("mps2.ld" if board.value.startswith("qemu") else "nrf52832.ld")
    linking = ("-nostartfiles", "--specs=nano.specs", "-Wl,--gc-sections", "-Wl,--print-memory-usage")
    usage = compiling.run_tool(
        [
            *(f"{_PREFIX}gcc", *options, f"-I{export}", *map(str, sources), *objects, *linking),
            *(f"-L{common}", "-T", str(script), "-o", str(elf), "-lm"),
        ]
    )
    sizes = {
        region: [int(number) << _UNIT_SHIFTS[unit] for number, unit in re.findall(r"(\d+) ([KMG]?B)", line)]
        for region, line in re.findall(r"^ *(FLASH|RAM): +(.*)", usage, re.MULTILINE)
    }
    (flash, available_flash_bytes), (ram, available_ram_bytes) = sizes["FLASH"], sizes["RAM"]
    return Image(elf, flash, ram, available_flash_bytes, available_ram_bytes)


def write_hex(image: Image, output: Path) -> None:
    """Write an image as Intel HEX, for the USB drive of a J-Link."""
    compiling.run_tool([f"{_PREFIX}objcopy", "-O", "ihex", str(image.elf), str(output)])
