"""The training loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training.networks import RemnetModule


@dataclass(frozen=True, slots=True)
class FitOptions:
    """How a network is fitted; the defaults are what the shipped bundle was trained with.

    Attributes:
        epochs: passes over the data.
        learning_rate: of Adam with decoupled weight decay (paper, section III-B).
        batch: inputs a step.
        dropout: share of the head's inputs that are dropped.
        weight_decay: decoupled.
        seed: of the initial weights, the order and the dropout.
    """

    epochs: int = 5
    learning_rate: float = 3e-4
    batch: int = 32
    dropout: float = 0.5
    weight_decay: float = 1e-2
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("epochs", self.epochs, 1, 10_000),
            ("learning_rate", self.learning_rate, 1e-8, 1.0),
            ("batch", self.batch, 1, 65_536),
            ("dropout", self.dropout, 0.0, 0.95),
            ("weight_decay", self.weight_decay, 0.0, 10.0),
            ("seed", self.seed, 0, 2**32 - 1),
        ):
            if not low <= value <= high:
                raise ParameterError(f"{name} = {value}", valid=f"{low} to {high}")


def fit(
    architecture: Remnet,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> FloatWeights:
    """Fit a network to `targets` (n,), m, from `inputs` (n, K), by mean absolute error.

    The same seed gives the same weights on the same machine. `on_epoch` is called after each pass.

    Raises:
        DatasetError: there are no inputs, they are not finite, or the loss diverges.
    """
    if len(inputs) == 0 or not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise DatasetError(f"cannot fit to {len(inputs)} inputs", valid="one or more, all finite")
    threads = torch.get_num_threads()
    # A network this small is slower on more threads, and sums in another order on each count of them.
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            return _fit(architecture, inputs, targets, options, on_epoch)
    finally:
        torch.set_num_threads(threads)


def _fit(
    architecture: Remnet,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    on_epoch: Callable[[], None],
) -> FloatWeights:
    network = RemnetModule(architecture, options.dropout)
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    source = torch.from_numpy(np.ascontiguousarray(inputs))
    wanted = torch.from_numpy(targets.astype(np.float32))
    network.train()
    for epoch in range(1, options.epochs + 1):
        for rows in torch.randperm(len(source)).split(options.batch):
            loss = torch.nn.functional.l1_loss(network(source[rows]), wanted[rows])
            if not torch.isfinite(loss):
                raise DatasetError(
                    f"the loss is {loss.item()} in epoch {epoch}", valid="try a lower learning rate"
                )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        on_epoch()
    return network.weights()
