"""Structured pruning (paper, section II-B): drop whole filters; the result is a smaller REMNet.

Residual sums tie channels together: the outputs of `first` and `module1.residual` are one set of channels, those
of `module1.reduce`, `module1.skip` and `module2.residual` the next, and so on. The same number of channels is kept in
each set, so that the result is a `Remnet` with fewer filters, which everything else can export and run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, ParameterError
from uwb_mitigation.evaluation.metrics import ErrorStatistics
from uwb_mitigation.model import floating, graph
from uwb_mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.model.bundle import Bundle, save_bundle
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.paper import experiment
from uwb_mitigation.paper.parts import Parts
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions


def prune(weights: FloatWeights, filters: int) -> FloatWeights:
    """Return `weights` with the `filters` strongest channels of each set.

    The strength of a channel is the L2 norm of the filters that write it, each relative to the mean of its layer.

    Raises:
        ModelError: the network is not a REMNet.
        ParameterError: `filters` is not smaller than the present number.
    """
    shape = weights.architecture
    if not isinstance(shape, Remnet):
        raise ModelError("only a REMNet can be pruned", valid="a bundle of a REMNet")
    if not 1 <= filters < shape.filters:
        raise ParameterError(f"filters = {filters}", valid=f"1 to {shape.filters - 1}")
    # The set of channels that each convolution reads and the one that it writes.
    sets: list[tuple[int | None, int]] = [(None, 0)]
    for module in range(shape.modules):
        sets += [(module, module), (module, module + 1), (module, module + 1)]
    layers = [(layer.name, *ends) for layer, ends in zip(shape.convolutions, sets, strict=True)]
    kept = []
    for channels in range(shape.modules + 1):
        strength = _strength(weights, [name for name, _, written in layers if written == channels])
        kept.append(np.sort(np.argsort(-strength)[:filters]))
    weight, bias = {}, {}
    for name, read, written in layers:
        values = weights.weight[name][kept[written]]
        weight[name] = np.ascontiguousarray(values if read is None else values[:, kept[read]])
        bias[name] = weights.bias[name][kept[written]]
    head = weights.weight[HEAD].reshape(shape.filters, -1)[kept[-1]]
    weight[HEAD], bias[HEAD] = head.reshape(-1, 1).copy(), weights.bias[HEAD].copy()
    return FloatWeights(replace(shape, filters=filters), weight, bias)


def prune_bundle(
    source: Bundle,
    parts: Parts,
    filters: int,
    options: FitOptions,
    output: Path,
    on_epoch: Callable[[], None] = lambda: None,
) -> tuple[Bundle, Mapping[str, float]]:
    """Prune a float bundle, train the result on the training part and write it.

    Returns:
        The new bundle, and the MAE on the test part, m: {`before`, `pruned`, `tuned`}.

    Raises:
        ModelError: the source is quantised, is not a REMNet, or was possibly fitted to the test part.
        ParameterError: see `prune`. DatasetError: see `fit`.
    """
    if source.quantised:
        raise ModelError("already quantised", where=str(source.path), valid="the float bundle it was made of")
    weights = graph.float_weights(source.model, source.architecture)
    smaller = prune(weights, filters)
    _check_trained_on(source, parts)
    train, test = parts.train, parts.test
    tuned = fit(smaller.architecture, train.inputs, train.error_m, options, on_epoch, start=smaller)
    found = {"raw": ErrorStatistics.of(test.error_m)} | {
        row: ErrorStatistics.of(test.error_m - floating.predict_m(network, test.inputs))
        for row, network in (("before", weights), ("pruned", smaller), ("tuned", tuned))
    }
    card = experiment.describe(output.stem, tuned.architecture, parts, options)
    training = {
        **card.training,
        "pruned": {
            "name": source.name,
            "from": f"{source.model_id:08x}",
            "architecture": asdict(weights.architecture),
            "recipe": source.card.training.get("recipe"),
        },
        "metrics_m": {
            row: {key: round(value, 4) for key, value in asdict(found[of]).items()}
            for row, of in (("raw", "raw"), ("float", "tuned"))
        },
    }
    bundle = save_bundle(output, graph.float_model(tuned), replace(card, training=training))
    return bundle, {row: one.mae for row, one in found.items() if row != "raw"}


def _check_trained_on(source: Bundle, parts: Parts) -> None:
    """Reject a bundle that was possibly fitted to the test part."""
    here = {
        "data": parts.data,
        "split": parts.split,
        "measurements": len(parts.train),
        "tested_on": len(parts.test),
    }
    trained = {key: source.card.training.get(key) for key in here}
    if trained != here:
        differ = "; ".join(
            f"{key} {trained[key]}, not {here[key]}" for key in here if trained[key] != here[key]
        )
        raise ModelError(
            f"possibly trained on the test part: {differ}",
            where=str(source.path),
            valid="a bundle of `paper protocol` with the same --data and --split",
        )


def _strength(weights: FloatWeights, names: list[str]) -> NDArray[np.float64]:
    norms = [np.sqrt((weights.weight[name].astype(np.float64) ** 2).sum(axis=(1, 2))) for name in names]
    total: NDArray[np.float64] = np.sum([norm / max(norm.mean(), 1e-12) for norm in norms], axis=0)
    return total
