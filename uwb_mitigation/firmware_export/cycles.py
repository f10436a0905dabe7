"""Estimates Cortex-M4 cycles from which instructions were executed, and how often.

The model is the instruction table of the Cortex-M4 r0p1 Technical Reference Manual (section 3.3.1): zero wait
states, a taken branch refills the pipeline in two cycles, and no load is hidden behind its neighbour. A board
that fetches code or weights from flash with wait states, or misses its cache, takes longer: that is for a board
to show.
"""

from __future__ import annotations

import re
from collections import Counter

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.firmware_export.compiling import run
from uwb_mitigation.firmware_export.toolchain import Image

_REFILL = 2
_DIVIDE = 12
_FLOAT_DIVIDE = 14

_LINE = re.compile(r"^\s*([0-9a-f]+):\t[0-9a-f ]+\t(\S+)(?:\t(.*))?$")


def estimate_cycles(image: Image, executed: Counter[tuple[int, bool]]) -> int:
    """Cycles of {(address, whether it branched): count}, as `emulator.count_executed` gives it.

    Raises:
        UwbMitigationError: an address holds no instruction of the image.
    """
    instructions = {}
    for line in run(["arm-none-eabi-objdump", "-d", "-w", str(image.elf)]).splitlines():
        match = _LINE.match(line)
        if match:
            instructions[int(match.group(1), 16)] = match.group(2), match.group(3) or ""
    total = 0
    for (address, branched), count in executed.items():
        if address not in instructions:
            raise UwbMitigationError(f"no instruction at {address:#x}", where=str(image.elf))
        total += count * (_cycles(*instructions[address]) + (_REFILL if branched else 0))
    return total


def _cycles(mnemonic: str, operands: str) -> int:
    name = mnemonic.split(".")[0]
    if name.startswith(("vldm", "vstm", "vpush", "vpop", "ldm", "stm", "push", "pop")):
        return 1 + _registers(operands)
    if name.startswith(("ldrd", "strd")):
        return 3
    if name.startswith(("vldr", "vstr", "ldr")):
        return 2
    if name.startswith(("vdiv", "vsqrt")):
        return _FLOAT_DIVIDE
    if name.startswith(("vfma", "vfms", "vmla", "vmls", "vfnma", "vfnms")):
        return 3
    if name.startswith(("sdiv", "udiv")):
        return _DIVIDE
    if name.startswith("vmov") and operands.count(",") == 3:
        return 2
    return 1


def _registers(operands: str) -> int:
    """The number of registers in a list such as {r4-r11, lr}."""
    inside = operands[operands.index("{") + 1 : operands.index("}")]
    total = 0
    for part in inside.split(","):
        ends = re.findall(r"\d+", part)
        words = 2 if part.strip().startswith("d") else 1
        total += words * (int(ends[1]) - int(ends[0]) + 1 if "-" in part and len(ends) == 2 else 1)
    return total
