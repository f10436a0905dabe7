"""Structured pruning (paper, section II-B): whole filters are dropped, and what is left is a smaller REMNet.

Residual sums tie channels together: the outputs of `first` and `module1.residual` are one set of channels, those
of `module1.reduce`, `module1.skip` and `module2.residual` the next, and so on. The same number is kept of each
set, so that the result is a `Remnet` with fewer filters, which everything else can export and run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, ParameterError
from uwb_mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions


def prune(weights: FloatWeights, filters: int) -> FloatWeights:
    """`weights` with the `filters` strongest channels of each set.

    A channel's strength is the L2 norm of the filters that write it, each in units of its layer's mean.

    Raises:
        ModelError: the network is not a REMNet.
        ParameterError: not fewer filters than there are.
    """
    shape = weights.architecture
    if not isinstance(shape, Remnet):
        raise ModelError("only a REMNet can be pruned", valid="a bundle of a REMNet")
    if not 1 <= filters < shape.filters:
        raise ParameterError(f"filters = {filters}", valid=f"1 to {shape.filters - 1}")
    kept = [np.sort(np.argsort(-_strength(weights, names))[:filters]) for names in _writers(shape)]
    weight, bias = {}, {}
    for number, (read, written) in enumerate(_sets(shape)):
        name = shape.convolutions[number].name
        values = weights.weight[name][kept[written]]
        weight[name] = np.ascontiguousarray(values if read is None else values[:, kept[read]])
        bias[name] = weights.bias[name][kept[written]]
    head = weights.weight[HEAD].reshape(shape.filters, -1)[kept[-1]]
    weight[HEAD], bias[HEAD] = head.reshape(-1, 1).copy(), weights.bias[HEAD].copy()
    return FloatWeights(replace(shape, filters=filters), weight, bias)


def prune_and_tune(
    weights: FloatWeights,
    filters: int,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> FloatWeights:
    """Prune, then train what is left on inputs (n, K) and targets (n,), m.

    Raises:
        ModelError, ParameterError: see `prune`. DatasetError: see `fit`.
    """
    smaller = prune(weights, filters)
    return fit(smaller.architecture, inputs, targets, options, on_epoch, start=smaller)


def _sets(shape: Remnet) -> list[tuple[int | None, int]]:
    """For each convolution, in order: the set of channels that it reads, and the one that it writes."""
    sets: list[tuple[int | None, int]] = [(None, 0)]
    for module in range(shape.modules):
        sets += [(module, module), (module, module + 1), (module, module + 1)]
    return sets


def _writers(shape: Remnet) -> list[list[str]]:
    """For each set of channels, the convolutions that write it."""
    writers: list[list[str]] = [[] for _ in range(shape.modules + 1)]
    for layer, (_, written) in zip(shape.convolutions, _sets(shape), strict=True):
        writers[written].append(layer.name)
    return writers


def _strength(weights: FloatWeights, names: list[str]) -> NDArray[np.float64]:
    norms = [np.sqrt((weights.weight[name].astype(np.float64) ** 2).sum(axis=(1, 2))) for name in names]
    total: NDArray[np.float64] = np.sum([norm / max(norm.mean(), 1e-12) for norm in norms], axis=0)
    return total
