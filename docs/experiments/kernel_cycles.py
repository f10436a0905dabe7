"""Divide the estimated cycles of REMNet on a Cortex-M4 by kind of instruction, and compare with ten times the paper's rate."""

import re
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks import firmware
from benchmarks.equipment import emulator
from benchmarks.equipment.random_networks import rounding_windows
from benchmarks.paper import published
from uwb_mitigation.mitigation.embedded.compiling import run_tool
from uwb_mitigation.mitigation.embedded.export import Golden, golden_windows, write_header
from uwb_mitigation.mitigation.embedded.toolchain import Kernels, Target, compile_image

KINDS = {
    "multiply-accumulate": "smla",
    "operands": "ldm|vmov",
    "requantise": "mla|smmla|usat",
    "start, store, pack": r"mov\b|st|vst|push|vpush|orr|ubfx|uxtb|bfi",
    "all other": "",
}
"""{kind: pattern of the mnemonic}; the first that matches."""


def main() -> None:
    """Print one row for each K of the paper."""
    print(f"| K | {' | '.join(KINDS)} | for ten times |")
    for network in firmware.random_shapes(
        [k for kind, k in published.MODELS if kind == "remnet"], [3], False
    ):
        windows = rounding_windows(network.packed.samples, network.packed.input_scale, 200)
        examples = golden_windows(network.packed)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            golden = Golden(examples, network.expect(examples))
            write_header(folder, network.packed, network.card, network.model_id, golden)
            image = compile_image(folder, folder, Target.QEMU_MPS2, Kernels.CORTEX_M4)
            executed = emulator.count_executed(image, windows[100])
            listing = run_tool(["arm-none-eabi-objdump", "-d", "-w", str(image.elf)])
            found = re.findall(r"^\s*([0-9a-f]+):\t[0-9a-f ]+\t(\S+)", listing, re.MULTILINE)
            mnemonics = {int(address, 16): mnemonic for address, mnemonic in found}
            parts: dict[str, Counter[tuple[int, bool]]] = {kind: Counter() for kind in KINDS}
            for key, count in executed.items():
                kind = next(kind for kind, pattern in KINDS.items() if re.match(pattern, mnemonics[key[0]]))
                parts[kind][key] = count
            cycles = [emulator.estimate_cycles(image, part) for part in parts.values()]
        rate_hz = published.MODELS["remnet", network.packed.samples].board[0]
        cycles.append(round(firmware.CLOCK_HZ / (10 * rate_hz)) - sum(cycles[:-1]))
        print(f"| {network.packed.samples} | {' | '.join(f'{value / 1000:.1f}' for value in cycles)} |")


if __name__ == "__main__":
    main()
