"""Run images for `boards/qemu_mps2` in qemu-system-arm, and count instructions.

Instructions are counted with the virtual time of the emulator: with `-icount shift=6` an instruction takes 64 ns and
SysTick ticks every 40 ns, so that the count is exact to one instruction. The emulator does not model wait states,
caches and power.

Cycles are estimated from the executed instructions with the Cortex-M4 Technical Reference Manual (Arm 100166_0001, sections
3.3.1 to 3.3.3, and 7.2.3 for the FPU), at zero wait states:

- every instruction by its table; a taken branch refills the pipeline in two cycles (the table: one to three);
- a load of one register directly after another one takes one cycle instead of two, if its address does not need the first one;
- a load or store takes one cycle more if its address is the result of the data-processing instruction directly before it;
- a floating-point result takes one cycle more if the next instruction needs it.

A board that fetches code or weights from flash with wait states, or has cache misses, takes longer.
"""

from __future__ import annotations

import itertools
import re
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.mitigation.embedded.compiling import run_tool
from uwb_mitigation.mitigation.embedded.toolchain import Image, Kernels, Target, compile_image, require_tools
from uwb_mitigation.types.measurement import RangeMeasurement

_MACHINE = ("qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none")
_TICKS_PER_INSTRUCTION = 64 / 40
_MAX_VALUES = 2 * 1016
_TIMEOUT_S = 600.0
_REFILL = 2
_DIVIDE = 12
_FLOAT_DIVIDE = 14

_LINE = re.compile(r"^\s*([0-9a-f]+):\t[0-9a-f ]+\t(\S+)(?:\t([^\t]*).*)?$")
_SINGLE_LOAD = re.compile("ldr(?!d)")
_IMMEDIATE_OFFSET = re.compile(r"\[\w+(, #-?\d+)?\]$")
_FLOAT_ARITHMETIC = re.compile("v(abs|add|cvt|div|f|m(?!ov|rs)|n|sqrt|sub)")
_NO_DATA_PROCESSING = re.compile("v|ldm|ldr|st|push|pop|b(?!ic|f)|cb|cm|tst|teq|it|nop")

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
_WINDOWS, _CIRS = 0, 1

_CIR_RECORD = np.dtype(
    [
        ("count", "<u4"),
        ("encoding", "<u4"),
        ("start_index", "<i4"),
        ("first_path_index", "<f4"),
        ("scale", "<f4"),
        ("preamble_count", "<u4"),
        ("rx_power_dbm", "<f4"),
        ("first_path_power_dbm", "<f4"),
        ("range_m", "<f4"),
        ("offset_m", "<f4"),
        ("samples", "<i2", (_MAX_VALUES,)),
    ]
)
_REPORT = np.dtype(
    [
        (name, "<u4")
        for name in ("model_id", "arena", "stack", "ticks_empty", "ticks_low", "ticks_high", "ticks_correct")
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class Emulation:
    """Results of a run.

    Attributes:
        model_id: id of the model in the image.
        records: structured array, one row per input. Windows: `status`, `output_m`. CIRs: `status`,
            `range_m`, `correction_m`, `variance_m2`, `range_status`, `window`.
        instructions: maximum per inference over all windows; 0 for CIRs.
        instructions_correct: maximum of preprocessing, linear bias model and inference together; 0 for windows.
        arena_bytes, stack_bytes: memory of one inference.
    """

    model_id: int
    records: NDArray[np.void]
    instructions: int
    instructions_correct: int
    arena_bytes: int
    stack_bytes: int


def run_windows(image: Image, windows: NDArray[np.float32]) -> Emulation:
    """Run the network on windows, float32 (n, K).

    Raises:
        MissingDependencyError: the emulator is missing.
        UwbMitigationError: the program fails, hangs or its output is incomplete.
    """
    record = np.dtype([("status", "<u4"), ("output_m", "<f4")])
    return _run(image, _WINDOWS, np.ascontiguousarray(windows, np.float32), record)


def run_measurements(
    image: Image, measurements: Sequence[RangeMeasurement], samples: int, offset_m: float = 0.0
) -> Emulation:
    """Correct measurements of radios with this offset; also return the preprocessed windows of `samples` values.

    Raises:
        ParameterError: a CIR is longer than the board's accumulator.
        MissingDependencyError, UwbMitigationError: as `run_windows`.
    """
    rows = np.zeros(len(measurements), _CIR_RECORD)
    for row, measurement in zip(rows, measurements, strict=True):
        cir = measurement.cir
        if len(cir.samples) > _MAX_VALUES:
            raise ParameterError(f"a CIR of {len(cir.samples)} values", valid=f"at most {_MAX_VALUES}")
        row["count"] = len(cir.samples)
        row["samples"][: len(cir.samples)] = cir.samples
        row["encoding"] = int(cir.encoding)
        row["range_m"] = measurement.range_m
        row["offset_m"] = offset_m
        for name in (
            "start_index",
            "first_path_index",
            "scale",
            "preamble_count",
            "rx_power_dbm",
            "first_path_power_dbm",
        ):
            row[name] = getattr(cir, name)
    record = np.dtype(
        [
            ("status", "<u4"),
            ("range_m", "<f4"),
            ("correction_m", "<f4"),
            ("variance_m2", "<f4"),
            ("range_status", "u1"),
            ("padding", "u1", (3,)),
            ("window", "<f4", (samples,)),
        ]
    )
    return _run(image, _CIRS, rows, record)


def count_executed(image: Image, window: NDArray[np.float32]) -> Counter[tuple[int, bool]]:
    """Count executions of each address in one inference: {(address, whether it then branched): count}.

    This is slow, because the emulator writes a line for each instruction.
    """
    require_tools()
    _write_input(image.elf.parent, _WINDOWS, np.ascontiguousarray(window[None], np.float32))
    symbols = _symbols(image)
    start = symbols["uwb_network"][0]
    first, last = symbols["run_window"]
    executed: list[int] = []
    inside = False
    # Trace 0: 0x7f... [cs_base/pc/flags/cflags] symbol
    pattern = re.compile(r"\[[0-9a-f]+/([0-9a-f]+)/")
    command = [*_command(image), "-singlestep", "-d", "exec,nochain"]
    with subprocess.Popen(
        command,
        cwd=image.elf.parent,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    ) as program:
        line = ""
        for line in program.stderr or ():
            match = pattern.search(line)
            if match is None:
                continue
            address = int(match.group(1), 16)
            inside = inside or address == start
            if inside and first <= address < last:
                break
            if inside:
                executed.append(address)
        program.kill()
    if not executed:
        raise UwbMitigationError(f"the emulator has executed no inference: {line.strip()}")
    following = [*executed[1:], -1]
    return Counter(
        (address, not 0 < after - address <= 4) for address, after in zip(executed, following, strict=True)
    )


def _symbols(image: Image) -> dict[str, tuple[int, int]]:
    """Return {function: (first address, one past the last)}."""
    functions = {}
    for line in run_tool(["arm-none-eabi-nm", "--print-size", "--defined-only", str(image.elf)]).splitlines():
        fields = line.split()
        if len(fields) == 4:
            start = int(fields[0], 16)
            functions[fields[3]] = (start, start + int(fields[1], 16))
    return functions


def _command(image: Image) -> list[str]:
    return [
        *_MACHINE,
        *("-icount", "shift=6"),
        *("-kernel", str(image.elf)),
        *("-semihosting-config", "enable=on,target=native"),
    ]


def _write_input(folder: Path, kind: int, rows: NDArray[np.generic]) -> None:
    header = np.array([kind, len(rows)], "<u4")
    (folder / "input.bin").write_bytes(header.tobytes() + rows.tobytes())


def _run(image: Image, kind: int, rows: NDArray[np.generic], record: np.dtype[np.void]) -> Emulation:
    require_tools()
    folder = image.elf.parent
    _write_input(folder, kind, rows)
    output = folder / "output.bin"
    output.unlink(missing_ok=True)
    run_tool(_command(image), _TIMEOUT_S, folder)
    data = output.read_bytes() if output.is_file() else b""
    expected = len(rows) * record.itemsize + _REPORT.itemsize
    if len(data) != expected:
        raise UwbMitigationError(
            f"the program wrote {len(data)} bytes", where=str(output), valid=f"{expected}"
        )
    report = np.frombuffer(data[-_REPORT.itemsize :], _REPORT)[0]
    empty = int(report["ticks_empty"])

    def instructions(ticks: int) -> int:
        return round((ticks - empty) / _TICKS_PER_INSTRUCTION) if ticks else 0

    return Emulation(
        model_id=int(report["model_id"]),
        records=np.frombuffer(data[: -_REPORT.itemsize], record),
        instructions=instructions(int(report["ticks_high"])),
        instructions_correct=instructions(int(report["ticks_correct"])),
        arena_bytes=int(report["arena"]),
        stack_bytes=int(report["stack"]),
    )


def measure_size(export: Path, build: Path, kernels: Kernels = Kernels.CORTEX_M4) -> Image:
    """Measure the size of a program that only corrects a range: vectors, start-up, library, model."""
    stub = build / "size.c"
    stub.write_text(_SIZE_STUB, encoding="utf-8")
    return compile_image(export, build, Target.DWM1001_DEV, kernels, stub)


def estimate_cycles(image: Image, executed: Counter[tuple[int, bool]]) -> int:
    """Estimate the cycles of {(address, whether it branched): count} from `count_executed`.

    Raises:
        UwbMitigationError: an address is not that of an instruction in the image.
    """
    instructions = {}
    for line in run_tool(["arm-none-eabi-objdump", "-d", "-w", str(image.elf)]).splitlines():
        match = _LINE.match(line)
        if match:
            instructions[int(match.group(1), 16)] = match.group(2), match.group(3) or ""
    total = 0
    for (address, branched), count in executed.items():
        if address not in instructions:
            raise UwbMitigationError(f"no instruction at {address:#x}", where=str(image.elf))
        total += count * (_cycles(*instructions[address]) + (_REFILL if branched else 0))
    for address, following in itertools.pairwise(sorted(instructions)):
        # After an instruction that did not branch, the processor executed the one behind it.
        total += executed[address, False] * _pairing(instructions[address], instructions[following])
    return total


def _cycles(mnemonic: str, operands: str) -> int:
    name = mnemonic.split(".")[0]
    if name.startswith(("vldm", "vstm", "vpush", "vpop", "ldm", "stm", "push", "pop")):
        return 1 + _registers(operands)
    if name.startswith(("ldrd", "strd")):
        return 3
    if name.startswith(("vldr", "vstr", "ldr")):
        return 2
    if name.startswith("str"):
        return 1 if _IMMEDIATE_OFFSET.search(operands) else 2
    if name.startswith(("vdiv", "vsqrt")):
        return _FLOAT_DIVIDE
    if name.startswith(("vfma", "vfms", "vmla", "vmls", "vfnma", "vfnms")):
        return 3
    if name.startswith(("sdiv", "udiv")):
        return _DIVIDE
    if name.startswith("vmov") and operands.count(",") == 3:
        return 2
    return 1


def _pairing(first: tuple[str, str], second: tuple[str, str]) -> int:
    """Return the cycles that an instruction takes more, or less, directly after another one."""
    (name, operands), (next_name, next_operands) = first, second
    result = operands.split(",")[0]
    if _FLOAT_ARITHMETIC.match(name):
        return int(result in re.findall(r"\w+", next_operands.partition(",")[2]))
    addressed = re.search(r"\[(.*?)\]", next_operands)
    if next_name.startswith(("ldm", "stm", "vldm", "vstm")):
        registers = [next_operands.split(",")[0].rstrip("!")]
    else:
        registers = re.findall(r"\w+", addressed[1]) if addressed else []
    if _SINGLE_LOAD.match(name):
        updates_base = not _IMMEDIATE_OFFSET.search(operands) and not re.search(r", \w+\]$", operands)
        return -1 if _SINGLE_LOAD.match(next_name) and result not in registers and not updates_base else 0
    return int(not _NO_DATA_PROCESSING.match(name) and result in registers)


def _registers(operands: str) -> int:
    """Return the number of registers in a list such as {r4-r11, lr}."""
    inside = operands[operands.index("{") + 1 : operands.index("}")]
    total = 0
    for names in inside.split(","):
        ends = re.findall(r"\d+", names)
        words = 2 if names.strip().startswith("d") else 1
        total += words * (int(ends[1]) - int(ends[0]) + 1 if "-" in names and len(ends) == 2 else 1)
    return total
