"""The training loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.model.architecture import Architecture
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training.learner import Learner, learner
from uwb_mitigation.training.options import FitOptions

__all__ = ["FitOptions", "descend", "fit", "single_thread"]


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
    `start` gives the weights of a REMNet that is trained further.

    Raises:
        DatasetError: there are no inputs, they are not finite, or the loss diverges.
    """
    with single_thread(options.seed):
        network = learner(architecture, options, start)
        descend(network, inputs, targets, options, on_epoch)
        return network.weights()


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
    network: Learner,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> None:
    """Train `network` for the epochs of `options`, in batches in random order.

    Raises:
        DatasetError: see `fit`.
    """
    if len(inputs) == 0 or not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise DatasetError(f"cannot fit to {len(inputs)} inputs", valid="one or more, all finite")
    source = torch.from_numpy(np.ascontiguousarray(inputs))
    wanted = torch.from_numpy(targets.astype(np.float32))
    for epoch in range(1, options.epochs + 1):
        for rows in torch.randperm(len(source)).split(options.batch):
            loss = network.step(source[rows], wanted[rows])
            if not math.isfinite(loss):
                raise DatasetError(f"the loss is {loss} in epoch {epoch}", valid="try a lower learning rate")
        on_epoch()
