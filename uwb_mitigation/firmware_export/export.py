"""From a model bundle to a folder with the C header that the firmware is built with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, UwbMitigationError
from uwb_mitigation.files import write_whole
from uwb_mitigation.firmware_export.header import Golden, ModelConstants, render
from uwb_mitigation.firmware_export.host import MODEL_HEADER
from uwb_mitigation.firmware_export.packing import PackedNetwork, pack
from uwb_mitigation.model import graph
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.model.runtime import Session

GOLDEN_VECTORS = 8


def export_bundle(bundle: Bundle, folder: Path) -> Path:
    """Write `uwb_model.h` for an int8 bundle to `folder`, and return its path.

    Raises:
        ModelError: the bundle is in float, of a shape without kernels, or has a layer without exact
            integer constants; the message says which.
        UwbMitigationError: the header cannot be written.
    """
    if not bundle.quantised:
        raise ModelError(
            "the firmware runs int8 networks only",
            where=str(bundle.path),
            valid="run `uwb-mitigation quantize`",
        )
    weights = graph.int8_weights(bundle.model, bundle.architecture)
    try:
        network = pack(weights)
    except ModelError as error:
        where = f"{bundle.path}, {error.where}" if error.where else str(bundle.path)
        raise ModelError(error.what, where=where, valid=error.valid) from error
    windows = golden_windows(network)
    golden = Golden(windows, IntegerNetwork(weights).predict_m(windows))
    return write_header(folder, network, identity(bundle), golden)


def write_header(folder: Path, network: PackedNetwork, identity: ModelConstants, golden: Golden) -> Path:
    """Write `uwb_model.h` to `folder`, which is made if need be; whole or not at all."""
    path = folder / MODEL_HEADER
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(path)) from error
    write_whole(path, render(network, identity, golden))
    return path


def identity(bundle: Bundle) -> ModelConstants:
    """What the header says of a bundle beside its network."""
    card = bundle.card
    return ModelConstants(
        name=card.name,
        model_id=bundle.model_id,
        scaling=card.preprocessing.scaling,
        prior=card.prior,
        correction_limits_m=card.correction_limits_m,
        variance_m2=card.variance_m2,
        variance_uncorrected_m2=card.variance_uncorrected_m2,
        variance_per_m2=card.variance_per_m2,
        familiarity=card.familiarity,
    )


def golden_windows(network: PackedNetwork) -> NDArray[np.float32]:
    """Inputs that are all zero, all saturated, and random at rising levels; the same every time."""
    random = np.random.default_rng(network.samples)
    levels = np.geomspace(8, 512, GOLDEN_VECTORS - 2)
    noise = random.uniform(0, 1, (GOLDEN_VECTORS - 2, network.samples)) * levels[:, None]
    rows = np.concatenate([np.zeros((1, network.samples)), np.full((1, network.samples), 1e4), noise])
    return (rows * float(network.input_scale)).astype(np.float32)


def compare_with_reference(bundle: Bundle) -> int:
    """Return the number of golden vectors for which ONNX Runtime and the integer reference are not bit-identical."""
    weights = graph.int8_weights(bundle.model, bundle.architecture)
    windows = golden_windows(pack(weights))
    given, expected = Session(bundle).predict_m(windows), IntegerNetwork(weights).predict_m(windows)
    return int(np.sum(given.view(np.uint32) != expected.view(np.uint32)))
