"""Export of a model bundle to `uwb_model.h`: constants, and golden vectors to test a build."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, UwbMitigationError
from uwb_mitigation.files import os_errors, write_atomically
from uwb_mitigation.mitigation.embedded.packing import Channels, PackedNetwork, pack
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, Session
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.ood import OodBands, check_float32
from uwb_mitigation.mitigation.model.requantisation import Sum

MODEL_HEADER = "uwb_model.h"
GOLDEN_VECTORS = 8

_COLUMNS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Golden:
    """Golden vectors: inputs, float32 (n, K), and the network's outputs, float32 (n,), m."""

    windows: NDArray[np.float32]
    outputs_m: NDArray[np.float32]


def export_bundle(bundle: Bundle, folder: Path) -> Path:
    """Write `uwb_model.h` for an int8 bundle to `folder`, and return its path.

    Raises:
        ModelError: the bundle is not quantised, the firmware has no kernels for its shape, or a layer has no
            exact integer constants; the message contains the reason.
        UwbMitigationError: the header cannot be written.
    """
    if not bundle.card.quantised:
        raise ModelError(
            "the firmware only runs int8 networks",
            where=bundle.path,
            valid="run `uwb-mitigation quantise`",
        )
    weights = graph.int8_weights(bundle.model, bundle.card.architecture)
    try:
        network = pack(weights)
    except ModelError as error:
        where = f"{bundle.path}, {error.where}" if error.where else str(bundle.path)
        raise ModelError(error.what, where=where, valid=error.valid) from error
    windows = golden_windows(network)
    golden = Golden(windows, IntegerNetwork(weights).predict_m(windows))
    return write_header(folder, network, bundle.card, bundle.model_id, golden)


def write_header(
    folder: Path, network: PackedNetwork, card: ModelCard, model_id: int, golden: Golden
) -> Path:
    """Write `uwb_model.h` to `folder`, which is created if it does not exist; the write is atomic."""
    path = folder / MODEL_HEADER
    with os_errors(UwbMitigationError, "cannot be written", path):
        folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, render(network, card, model_id, golden))
    return path


def golden_windows(network: PackedNetwork) -> NDArray[np.float32]:
    """Return inputs that are all zero, all saturated, and random at rising levels; deterministic."""
    random = np.random.default_rng(network.samples)
    levels = np.geomspace(8, 512, GOLDEN_VECTORS - 2)
    noise = random.uniform(0, 1, (GOLDEN_VECTORS - 2, network.samples)) * levels[:, None]
    rows = np.concatenate([np.zeros((1, network.samples)), np.full((1, network.samples), 1e4), noise])
    return (rows * float(network.input_scale)).astype(np.float32)


def compare_with_reference(bundle: Bundle) -> int:
    """Return the number of golden vectors for which ONNX Runtime and the integer reference are not bit-identical."""
    weights = graph.int8_weights(bundle.model, bundle.card.architecture)
    windows = golden_windows(pack(weights))
    host_m, expected = Session(bundle).predict_m(windows), IntegerNetwork(weights).predict_m(windows)
    return int(np.sum(host_m.view(np.uint32) != expected.view(np.uint32)))


def render(network: PackedNetwork, card: ModelCard, model_id: int, golden: Golden) -> str:
    """Return the text of `uwb_model.h`: `uwb_model_data`, and golden vectors under UWB_GOLDEN_VECTORS.

    Floats have nine significant digits, so that they are read back with the same bits.
    """
    sections = [
        f"/* {_comment(card.name)}, model {model_id:08x}, written by `uwb-mitigation board export-c`. */",
        "#ifndef UWB_MODEL_H\n#define UWB_MODEL_H\n",
        '#include "uwb_mitigation.h"\n',
    ]
    sections += _remnet(network) if network.modules else _mlp(network)
    sections.append(_array("int16_t", "uwb_head_weights", network.head_weights))
    if card.ood_bands is not None:
        sections.append(_ood_bands(card.ood_bands))
    sections.append(_scale(card))
    sections.append(_model(network, card, model_id))
    sections.append(_golden(golden))
    sections.append("#endif")
    return "\n".join(sections) + "\n"


def _remnet(network: PackedNetwork) -> Iterable[str]:
    assert network.first is not None
    yield _array("int16_t", "uwb_first_weights", network.first_weights.reshape(-1))
    yield _channels("uwb_first", network.first)
    for number, module in enumerate(network.modules, start=1):
        prefix = f"uwb_module{number}"
        yield _array("int32_t", f"{prefix}_residual_weights", module.residual_weights)
        yield _channels(f"{prefix}_residual", module.residual)
        yield _array("int16_t", f"{prefix}_reduce_weights", module.reduce_weights)
        yield _channels(f"{prefix}_reduce", module.reduce)
        yield _channels(f"{prefix}_skip", module.skip)
    yield "static const uwb_module uwb_modules[] = {"
    for number, module in enumerate(network.modules, start=1):
        prefix = f"uwb_module{number}"
        yield f"    {{{prefix}_residual_weights, {prefix}_residual, {_sum(module.residual_sum)},"
        yield f"     {prefix}_reduce_weights, {prefix}_reduce, {prefix}_skip, {_sum(module.output_sum)}}},"
    yield "};\n"


def _mlp(network: PackedNetwork) -> Iterable[str]:
    for number, layer in enumerate(network.layers, start=1):
        yield _array("int8_t", f"uwb_dense{number}_weights", layer.weights)
        yield _channels(f"uwb_dense{number}", layer.channels)
    yield "static const uwb_dense_layer uwb_layers[] = {"
    for number, layer in enumerate(network.layers, start=1):
        yield f"    {{uwb_dense{number}_weights, uwb_dense{number}, {layer.inputs}u, {layer.outputs}u}},"
    yield "};\n"


def _ood_bands(ood_bands: OodBands) -> str:
    bands = "".join(
        f"    {{{format_number(band.low)}, {format_number(band.high)}, {format_number(np.float32(1) / np.float32(band.margin))}}},\n"
        if band
        else "    {0.0f, 0.0f, 0.0f},\n"
        for band in ood_bands.bands
    )
    offset = format_number(ood_bands.known_offset_m)
    return f"static const uwb_ood_bands uwb_model_ood_bands = {{{offset}, {{\n{bands}}}}};\n"


def _scale(card: ModelCard) -> str:
    rows = (f"{{{', '.join(map(format_number, line.tolist()))}}}" for line in card.scale_lines)
    return f"static const uwb_scale_line uwb_model_scale[] = {{\n{_wrapped(rows)}}};\n"


def _model(network: PackedNetwork, card: ModelCard, model_id: int) -> str:
    remnet = bool(network.modules)
    values = [
        f"0x{model_id:08x}u",
        f"{network.samples}u",
        f"UWB_SCALE_{card.preprocessing.scaling.name}",
        format_number(network.input_scale),
        f"{network.first_kernel}u",
        f"{len(network.modules)}u",
        "uwb_first_weights" if remnet else "NULL",
        "uwb_first" if remnet else "NULL",
        "uwb_modules" if remnet else "NULL",
        f"{len(network.layers)}u",
        "NULL" if remnet else "uwb_layers",
        "uwb_head_weights",
        f"{len(network.head_weights)}u",
        f"{network.head_bias}",
        format_number(network.head_scale),
        *map(format_number, astuple(card.linear_bias)),
        *map(format_number, card.correction_limits_m),
        format_number(card.variance_uncorrected_m2),
        "uwb_model_scale",
        f"{len(card.scale)}u",
        "NULL" if card.ood_bands is None else "&uwb_model_ood_bands",
        f"{int(card.early_path)}",
    ]
    return f"static const uwb_model uwb_model_data = {{\n{_wrapped(values)}}};\n"


def _golden(golden: Golden) -> str:
    count, samples = golden.windows.shape
    rows = "\n".join(f"    {{\n{_wrapped(map(format_number, row.tolist()))}    }}," for row in golden.windows)
    outputs = _wrapped(map(format_number, golden.outputs_m.tolist()))
    return (
        "#ifdef UWB_GOLDEN_VECTORS\n"
        f"enum {{ UWB_GOLDEN_COUNT = {count} }};\n"
        f"static const float uwb_golden_windows[{count}][{samples}] = {{\n{rows}\n}};\n"
        f"static const float uwb_golden_outputs_m[{count}] = {{\n{outputs}}};\n"
        "#endif\n"
    )


def format_number(value: float | np.floating[Any]) -> str:
    """Return a float32 as a C literal that is read back with the same bits.

    Raises:
        ModelError: the value is not finite or not a float32.
    """
    with np.errstate(over="ignore"):
        check_float32("a number of the model", float(value))
    digits = f"{float(value):.9g}"
    if not re.search(r"[.e]", digits):
        digits += ".0"
    return digits + "f"


def _array(kind: str, name: str, values: NDArray[np.generic]) -> str:
    # The assembly loads words: align the array.
    return (
        f"static const {kind} {name}[{values.size}] __attribute__((aligned(4))) = {{\n"
        f"{_wrapped(map(str, values.tolist()))}}};\n"
    )


def _channels(name: str, channels: Channels) -> str:
    texts = (f"{{{', '.join(map(str, row))}}}" for row in np.stack(channels, -1).tolist())
    return f"static const uwb_channel {name}[{len(channels.bias)}] = {{\n{_wrapped(texts)}}};\n"


def _sum(total: Sum) -> str:
    return f"{{{total.first}, {total.second}, {total.offset}}}"


def _wrapped(items: Iterable[str]) -> str:
    lines, line = [], "   "
    for item in items:
        if len(line) + len(item) + 2 > _COLUMNS:
            lines.append(line)
            line = "   "
        line += f" {item},"
    return "".join(f"{text}\n" for text in [*lines, line])


def _comment(text: str) -> str:
    return re.sub(r"[^\w .,()=+-]", "_", text)[:80]
