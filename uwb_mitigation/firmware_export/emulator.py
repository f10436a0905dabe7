"""Runs images for `boards/qemu_mps2` in qemu-system-arm, and counts what they execute.

Instruction counts are those of the emulator's virtual time: with `-icount shift=6` an instruction takes 64 ns
and SysTick ticks every 40 ns, so that the count is exact to one instruction. An emulator knows no wait
states, no caches and no power.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.firmware_export.compiling import run
from uwb_mitigation.firmware_export.toolchain import Image, require_tools
from uwb_mitigation.measurement import RangeMeasurement

_MACHINE = ("qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none")
_TICKS_PER_INSTRUCTION = 64 / 40
_MAX_VALUES = 2 * 1016
_TIMEOUT_S = 600.0
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
    """What a run gave.

    Attributes:
        model_id: of the image's model.
        records: structured array, a row for each input. Windows: `status`, `output_m`. CIRs: `status`,
            `range_m`, `correction_m`, `variance_m2`, `range_status`, `window`.
        instructions: of one inference, the most over all windows; 0 for CIRs.
        instructions_correct: of preprocessing, prior and inference together; 0 for windows.
        arena_bytes, stack_bytes: memory of one inference.
    """

    model_id: int
    records: NDArray[np.void]
    instructions: int
    instructions_correct: int
    arena_bytes: int
    stack_bytes: int


def run_windows(image: Image, windows: NDArray[np.float32]) -> Emulation:
    """The network's outputs for windows, float32 (n, K).

    Raises:
        MissingDependencyError: the emulator is missing.
        UwbMitigationError: the program fails, hangs or writes less than it should.
    """
    record = np.dtype([("status", "<u4"), ("output_m", "<f4")])
    return _run(image, _WINDOWS, np.ascontiguousarray(windows, np.float32), record)


def run_measurements(
    image: Image, measurements: Sequence[RangeMeasurement], samples: int, offset_m: float = 0.0
) -> Emulation:
    """Corrected ranges of measurements, of radios with this offset, and the windows of `samples` values that preprocessing gave.

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
    """How often one inference executes each address: {(address, whether it then branched): count}.

    Slow: the emulator writes a line for each instruction.
    """
    require_tools()
    folder = image.elf.parent
    _write_input(folder, _WINDOWS, np.ascontiguousarray(window[None], np.float32))
    trace = folder / "trace.txt"
    run([*_command(image), "-singlestep", "-d", "exec,nochain", "-D", str(trace)], folder=folder)
    symbols = _symbols(image)
    start = symbols["uwb_network"][0]
    first, last = symbols["run_window"]
    executed: list[int] = []
    inside = False
    # Trace 0: 0x7f... [cs_base/pc/flags/cflags] symbol
    pattern = re.compile(r"\[[0-9a-f]+/([0-9a-f]+)/")
    with trace.open(encoding="ascii", errors="replace") as lines:
        for line in lines:
            match = pattern.search(line)
            if match is None:
                continue
            address = int(match.group(1), 16)
            inside = inside or address == start
            if inside and first <= address < last:
                break
            if inside:
                executed.append(address)
    trace.unlink()
    following = [*executed[1:], -1]
    return Counter(
        (address, not 0 < after - address <= 4) for address, after in zip(executed, following, strict=True)
    )


def _symbols(image: Image) -> dict[str, tuple[int, int]]:
    """{function: (first address, one past the last)}."""
    found = {}
    for line in run(["arm-none-eabi-nm", "--print-size", "--defined-only", str(image.elf)]).splitlines():
        fields = line.split()
        if len(fields) == 4:
            start = int(fields[0], 16)
            found[fields[3]] = (start, start + int(fields[1], 16))
    return found


def _command(image: Image) -> list[str]:
    # Names without folders: the program splits its arguments at spaces.
    arguments = "arg=firmware,arg=input.bin,arg=output.bin"
    return [
        *_MACHINE,
        *("-icount", "shift=6"),
        *("-kernel", str(image.elf)),
        *("-semihosting-config", f"enable=on,target=native,{arguments}"),
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
    run(_command(image), _TIMEOUT_S, folder)
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
