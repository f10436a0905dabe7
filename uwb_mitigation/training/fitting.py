"""The training loop: torch's gradients and its Adam, on data that lies in memory as a whole."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.model.architecture import Architecture
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import networks
from uwb_mitigation.training.options import FitOptions

__all__ = ["FitOptions", "descend", "fit", "fit_varied", "single_thread"]


STAGES = ((0.6, 1.0), (0.9, 0.3), (1.0, 0.1))
"""Up to which share of the steps `fit_varied` keeps which factor of the learning rate."""

MEAN_KEEPS = 0.999
"""Of its running mean of the weights, at each step."""


def fit(
    architecture: Architecture,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
    *,
    start: FloatWeights | None = None,
) -> FloatWeights:
    """Fit a network to `targets` (n,), m, from `inputs` (n, K), by mean absolute error.

    The same seed gives the same weights on the same machine. `on_epoch` is called after each pass.

    Args:
        start: weights that are trained further; without it, fresh ones.

    Raises:
        DatasetError: there are no inputs, they are not finite, or the loss diverges.
    """
    with single_thread(options.seed):
        network = networks.build(architecture, options.dropout, start)
        descend(network, inputs, targets, options, on_epoch)
        return networks.weights_of(network)


def fit_varied(
    architecture: Architecture,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    vary: Callable[[Tensor, torch.Generator], Tensor],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> FloatWeights:
    """Fit a network as `fit` does, each batch varied by `vary`, at a learning rate that falls in `STAGES`.

    The result is a running mean of the weights, which takes the scatter of the last steps out.

    Raises:
        DatasetError: see `fit`.
    """
    source, wanted = as_tensors(inputs, targets)
    with single_thread(options.seed):
        # Of its own, so that what is varied changes neither order nor dropout.
        generator = torch.Generator().manual_seed(options.seed + 77)
        network = networks.build(architecture, options.dropout)
        optimizer = adam(network, options)
        means = [weight.detach().clone() for weight in network.parameters()]
        network.train()
        steps, done = options.epochs * -(-len(source) // options.batch), 0
        for epoch in range(1, options.epochs + 1):
            for rows in torch.randperm(len(source)).split(options.batch):
                factor = next(factor for until, factor in STAGES if done < until * steps)
                optimizer.param_groups[0]["lr"] = options.learning_rate * factor
                _check(step(network, optimizer, vary(source[rows], generator), wanted[rows]), epoch)
                done += 1
                # The first steps count less, or the mean would hold on to the initial weights.
                kept = min(MEAN_KEEPS, (1 + done) / (10 + done))
                for mean, weight in zip(means, network.parameters(), strict=True):
                    mean.lerp_(weight.detach(), 1.0 - kept)
            on_epoch()
        with torch.no_grad():
            for mean, weight in zip(means, network.parameters(), strict=True):
                weight.copy_(mean)
        return networks.weights_of(network)


@contextmanager
def single_thread(seed: int) -> Iterator[None]:
    """One thread and seeded randomness for torch; the caller's are restored after.

    A network this small is slower on more threads, and sums in another order on each count of them.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)


def descend(
    network: nn.Module,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> None:
    """Train `network`, (n, K) to (n,), for the epochs of `options`, in batches in random order.

    Raises:
        DatasetError: see `fit`.
    """
    source, wanted = as_tensors(inputs, targets)
    optimizer = adam(network, options)
    network.train()
    for epoch in range(1, options.epochs + 1):
        for rows in torch.randperm(len(source)).split(options.batch):
            _check(step(network, optimizer, source[rows], wanted[rows]), epoch)
        on_epoch()


def predict_m(network: nn.Module, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """What `network` predicts of inputs (n, K), float32 (n,), m, without dropout."""
    network.eval()
    with torch.no_grad():
        parts = [network(part).numpy() for part in torch.from_numpy(inputs).split(1024)]
    predicted: NDArray[np.float32] = np.concatenate(parts)
    return predicted


def as_tensors(inputs: NDArray[np.float32], targets: NDArray[np.floating]) -> tuple[Tensor, Tensor]:
    """Inputs (n, K) and targets (n,) as float32 tensors.

    Raises:
        DatasetError: there are none, or they are not finite.
    """
    if len(inputs) == 0 or not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise DatasetError(f"cannot fit to {len(inputs)} inputs", valid="one or more, all finite")
    return torch.from_numpy(np.ascontiguousarray(inputs)), torch.from_numpy(targets.astype(np.float32))


def adam(network: nn.Module, options: FitOptions) -> torch.optim.Optimizer:
    """Adam (paper, section III-B: 0.9, 0.999, 1e-8, torch's own defaults) with decoupled weight decay."""
    return torch.optim.AdamW(
        network.parameters(), options.learning_rate, weight_decay=options.weight_decay, fused=True
    )


def step(network: nn.Module, optimizer: torch.optim.Optimizer, inputs: Tensor, targets: Tensor) -> float:
    """Update the network by one batch, (n, K) and (n,); returns the mean absolute error before, m."""
    optimizer.zero_grad()
    loss = nn.functional.l1_loss(network(inputs), targets)
    loss.backward()
    optimizer.step()
    return float(loss.item())


def _check(loss: float, epoch: int) -> None:
    if not math.isfinite(loss):
        raise DatasetError(f"the loss is {loss} in epoch {epoch}", valid="try a lower learning rate")
