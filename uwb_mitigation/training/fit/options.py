"""Training options. This module does not import torch, so that the command line can check options quickly."""

from __future__ import annotations

from dataclasses import dataclass

from uwb_mitigation.errors import check_range


@dataclass(frozen=True, slots=True)
class FitOptions:
    """Training options of a network; the defaults are those of the shipped bundle.

    Attributes:
        epochs: passes over the data.
        learning_rate: learning rate of Adam with decoupled weight decay (paper, section III-B).
        batch: batch size.
        dropout: dropout rate of the head's inputs; only for REMNet.
        weight_decay: decoupled weight decay.
        seed: seed of the initial weights, the order and the dropout.
    """

    epochs: int = 5
    learning_rate: float = 3e-4
    batch: int = 32
    dropout: float = 0.5
    weight_decay: float = 1e-2
    seed: int = 0

    def __post_init__(self) -> None:
        check_range("training", "epochs", self.epochs, 1, 10_000)
        check_range("training", "learning_rate", self.learning_rate, 1e-8, 1.0)
        check_range("training", "batch", self.batch, 1, 65_536)
        check_range("training", "dropout", self.dropout, 0.0, 0.95)
        check_range("training", "weight_decay", self.weight_decay, 0.0, 10.0)
        check_range("training", "seed", self.seed, 0, 2**32 - 1)
