"""Measure exported models in the emulator.

Measures instructions, estimated cycles, memory, and equality with ONNX Runtime.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from benchmarks.equipment import emulator
from benchmarks.equipment.random_networks import mlp, remnet, rounding_windows
from benchmarks.paper import published
from uwb_mitigation.mitigation.embedded.export import Golden, golden_windows, write_header
from uwb_mitigation.mitigation.embedded.packing import PackedNetwork, pack
from uwb_mitigation.mitigation.embedded.toolchain import Kernels, Target, compile_image
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Mlp
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, session_options
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import Int8Weights
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.simulation.simulated import SimulatedSource

CLOCK_HZ = 64e6
"""Clock of the board in the paper, an Arduino Nano 33 BLE Sense."""

DEFAULT_INPUTS, CORRECTIONS = 5000, 200


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """A network to measure.

    Attributes:
        network: `remnet` or `mlp`, as in `paper.published`.
        first_kernel: k0; 0 for an MLP.
        packed: model in the format of the firmware.
        card, model_id: properties of the model in the header.
        onnx: the serialised ONNX model.
    """

    network: str
    first_kernel: int
    packed: PackedNetwork
    card: ModelCard
    model_id: int
    onnx: bytes

    def expect(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the outputs of ONNX Runtime for windows (n, K)."""
        session = onnxruntime.InferenceSession(
            self.onnx, session_options(), providers=["CPUExecutionProvider"]
        )
        outputs: NDArray[np.float32] = session.run(None, {graph.INPUT: windows[:, None, :]})[0][:, 0]
        return outputs


@dataclass(frozen=True, slots=True)
class NetworkCost:
    """One measurement; the keys of `bench firmware`.

    Attributes:
        model: `remnet` or `mlp`.
        k, k0: window length and first kernel; k0 is 0 for an MLP.
        kernels: `cortex_m4` (assembly) or `portable` (C, -O3).
        instructions: maximum per inference from a window of floats, over all inputs.
        instructions_correct: maximum per correction of a simulated CIR: preprocessing, OOD score, search for a missed direct
            path, and inference. `instructions_early_path`: how much less without the search. None: random weights.
        cycles_estimated: at zero wait states, see `cycles`.
        ram_bytes: size of the arena, without `stack_bytes`.
        flash_bytes: size of an image that only corrects ranges.
        mismatches, inputs: number of outputs that differ from ONNX Runtime's in any bit, and number of inputs.
        hz: rate at 64 MHz; `energy_mj` at the power of the paper; `paper_hz`; None if the paper has no value.
    """

    model: str
    k: int
    k0: int
    kernels: str
    instructions: int
    cycles_estimated: int
    ram_bytes: int
    stack_bytes: int
    flash_bytes: int
    mismatches: int
    inputs: int
    hz: float
    energy_mj: float | None
    paper_hz: float | None
    instructions_correct: int | None = None
    instructions_early_path: int | None = None


def random_shapes(
    windows: Sequence[int] = published.WINDOWS, first_kernels: Sequence[int] = (3, 5), dense: bool = True
) -> Iterator[Network]:
    """Return a random network of every requested shape."""
    for first_kernel in first_kernels:
        for samples in windows:
            weights = remnet(samples, first_kernel)
            yield network_of(weights, None, 0, graph.int8_model(weights))
    if dense:
        weights = mlp()
        yield network_of(weights, None, 0, graph.int8_model(weights))


def trained(bundle: Bundle) -> Network:
    """Return a trained model to measure.

    Raises:
        ModelError: see `export_bundle`.
    """
    return network_of(
        graph.int8_weights(bundle.model, bundle.card.architecture), bundle.card, bundle.model_id, bundle.model
    )


def network_of(weights: Int8Weights, card: ModelCard | None, model_id: int, onnx: bytes) -> Network:
    """Return a network to measure; `card` None = a neutral one."""
    shape = weights.architecture
    network, first_kernel = ("mlp", 0) if isinstance(shape, Mlp) else ("remnet", shape.first_kernel)
    card = card or ModelCard(
        "random weights",
        shape,
        Preprocessing(shape.samples, Scaling.PREAMBLE),
        LinearBiasModel(0.0),
        quantised=True,
        variance_m2=1.0,
        variance_uncorrected_m2=1.0,
        correction_limits_m=(-1e3, 1e3),
    )
    return Network(network, first_kernel, pack(weights), card, model_id, onnx)


def measure(
    network: Network,
    windows: NDArray[np.float32] | None = None,
    kernels: Kernels = Kernels.CORTEX_M4,
    inputs: int = DEFAULT_INPUTS,
) -> NetworkCost:
    """Measure one network on `windows`, float32 (n, K), or on `inputs` windows that test every rounding.

    Raises:
        MissingDependencyError: compiler or emulator are missing; the message contains the command to install them.
        UwbMitigationError: the build or the run fails.
    """
    packed = network.packed
    if windows is None:
        windows = rounding_windows(packed.samples, packed.input_scale, inputs)
    expected = network.expect(windows)
    examples = golden_windows(packed)
    golden = Golden(examples, network.expect(examples))
    with tempfile.TemporaryDirectory(prefix="uwb_firmware_") as name:
        folder = Path(name)
        write_header(folder, packed, network.card, network.model_id, golden)
        image = compile_image(folder, folder, Target.QEMU_MPS2, kernels)
        result = emulator.run_windows(image, windows)
        cycles = emulator.estimate_cycles(image, emulator.count_executed(image, windows[len(windows) // 2]))
        flash = emulator.measure_size(folder, folder, kernels).flash_bytes
    published_model = published.MODELS.get((network.network, packed.samples))
    hz = CLOCK_HZ / cycles
    wrong = (result.records["output_m"].view(np.uint32) != expected.view(np.uint32)) | (
        result.records["status"] != 0
    )
    whole, search = _correction_instructions(network, golden, kernels) if network.model_id else (None, None)
    return NetworkCost(
        model=network.network,
        k=packed.samples,
        k0=network.first_kernel,
        kernels=kernels.value,
        instructions=result.instructions,
        cycles_estimated=cycles,
        ram_bytes=result.arena_bytes,
        stack_bytes=result.stack_bytes,
        flash_bytes=flash,
        mismatches=int(np.count_nonzero(wrong)),
        inputs=len(windows),
        hz=hz,
        energy_mj=None if published_model is None else published_model.board[3] / hz,
        paper_hz=None if published_model is None else published_model.board[0],
        instructions_correct=whole,
        instructions_early_path=search,
    )


def _correction_instructions(network: Network, golden: Golden, kernels: Kernels) -> tuple[int, int]:
    """Return the maximum per correction of a simulated CIR, and the share of the search for a missed direct path."""
    measurements = [record.measurement for record in SimulatedSource(seed=3, count=CORRECTIONS)]
    counts = []
    for card in (network.card, replace(network.card, early_path=False)):
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_") as name:
            folder = Path(name)
            write_header(folder, network.packed, card, network.model_id, golden)
            image = compile_image(folder, folder, Target.QEMU_MPS2, kernels)
            result = emulator.run_measurements(image, measurements, network.packed.samples)
        counts.append(result.instructions_correct)
    return counts[0], counts[0] - counts[1]
