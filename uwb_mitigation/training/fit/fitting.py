"""Training loop with Adam in PyTorch, on data in memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adamw import adamw
from torch.optim.swa_utils import AveragedModel

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model.architecture import Architecture
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.fit import networks
from uwb_mitigation.training.fit.options import FitOptions

STAGES = ((0.6, 1.0), (0.9, 0.3), (1.0, 0.1))
"""Schedule of `fit` with `vary`: (share of the steps until which it applies, factor of the learning rate)."""

MEAN_DECAY = 0.999
"""Decay of the running mean of the weights per step."""


class Adam:
    """Adam with decoupled weight decay, with the betas and epsilon of the paper (section III-B), which are torch's defaults.

    The same kernel as `torch.optim.AdamW`, which imports torch's compiler in 3 s.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], weight_decay: float) -> None:
        self._parameters, self._weight_decay = list(parameters), weight_decay
        self._means, self._squares = (
            [torch.zeros_like(weight, memory_format=torch.preserve_format) for weight in self._parameters]
            for _ in range(2)
        )
        self._steps = [torch.zeros(()) for _ in self._parameters]

    def step(self, learning_rate: float) -> None:
        """Change the parameters by their gradients, and remove these."""
        gradients = [weight.grad for weight in self._parameters]
        no_maxima: list[Tensor] = []
        state = self._means, self._squares, no_maxima, self._steps
        options = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "amsgrad": False, "maximize": False}
        rates = {"lr": learning_rate, "weight_decay": self._weight_decay}
        with torch.no_grad():
            adamw(self._parameters, gradients, *state, fused=True, **rates, **options)
        for weight in self._parameters:
            weight.grad = None


def fit(
    architecture: Architecture,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
    *,
    vary: Callable[[Tensor, torch.Generator], Tensor] | None = None,
) -> FloatWeights:
    """Fit a network to `targets` by mean absolute error.

    The same seed gives the same weights on the same machine.

    Args:
        architecture: shape of the network.
        inputs: float32 (n, K).
        targets: (n,), m.
        options: training options.
        on_epoch: called after each pass over the data.
        vary: augments each batch. The learning rate then decreases in `STAGES`, and the result is a running mean of the
            weights, which removes the scatter of the last steps.

    Raises:
        DatasetError: there are no inputs, they are not finite, or the loss diverges.
    """
    if len(inputs) == 0 or not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise DatasetError(f"cannot fit to {len(inputs)} inputs", valid="one or more, all finite")
    source = torch.from_numpy(np.ascontiguousarray(inputs))
    target_values = torch.from_numpy(targets.astype(np.float32))
    with single_thread(options.seed):
        # A separate generator, so that augmentation changes neither the order nor the dropout.
        generator = torch.Generator().manual_seed(options.seed + 77)
        network = networks.Network(architecture, options.dropout)
        optimizer, rate = Adam(network.parameters(), options.weight_decay), options.learning_rate
        mean = AveragedModel(network, avg_fn=_running_mean)
        # Start from the initial weights.
        mean.update_parameters(network)
        network.train()
        steps, step = options.epochs * -(-len(source) // options.batch), 0
        for epoch in range(1, options.epochs + 1):
            for rows in torch.randperm(len(source)).split(options.batch):
                batch = source[rows]
                if vary is not None:
                    rate = options.learning_rate * _rate_factor(step, steps)
                    batch = vary(batch, generator)
                loss = nn.functional.l1_loss(network(batch), target_values[rows])
                loss.backward()
                optimizer.step(rate)
                _check_loss(loss.item(), epoch)
                step += 1
                if vary is not None:
                    mean.update_parameters(network)
            on_epoch()
        return networks.weights_of(network if vary is None else mean.module)


def _check_loss(loss: float, epoch: int) -> None:
    if not math.isfinite(loss):
        raise DatasetError(f"the loss is {loss} in epoch {epoch}", valid="try a lower learning rate")


def _rate_factor(step: int, steps: int) -> float:
    return next(factor for until, factor in STAGES if step < until * steps)


def _running_mean(mean: Tensor, weight: Tensor, step: Tensor | int) -> Tensor:
    """Return the mean after `step`, from 1; it adapts faster at first, so that the initial weights have no effect."""
    return mean.lerp(weight, 1.0 - min(MEAN_DECAY, (1 + int(step)) / (10 + int(step))))


@contextmanager
def single_thread(seed: int) -> Iterator[None]:
    """Use one thread and seeded randomness in torch, and restore the caller's.

    A network of this size is slower with more threads, and its sums depend on their number.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)
