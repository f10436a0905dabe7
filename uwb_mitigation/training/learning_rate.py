"""The learning-rate range test (Smith 2017): the rate rises with every batch, and the loss is watched."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.model.architecture import Architecture
from uwb_mitigation.training import networks
from uwb_mitigation.training.fitting import adam, as_tensors, single_thread
from uwb_mitigation.training.fitting import step as train_step
from uwb_mitigation.training.options import FitOptions

SMOOTHING = 0.95
"""Weight of the past in the running mean of the losses."""

DIVERGED = 4.0
"""The test ends where the smoothed loss is so many times its least."""


@dataclass(frozen=True, slots=True)
class RangeTest:
    """Attributes:
    rates: of each step.
    losses_m: smoothed mean absolute error at each step, m; as many as rates.
    suggested: the rate at which the loss falls steepest, per factor of the rate.
    highest: the rate at which the loss is least; beyond it training becomes unstable.
    diverged: whether the loss exploded before the last rate.
    """

    rates: tuple[float, ...]
    losses_m: tuple[float, ...]
    suggested: float
    highest: float
    diverged: bool


def range_test(
    architecture: Architecture,
    inputs: NDArray[np.float32],
    targets: NDArray[np.floating],
    options: FitOptions,
    *,
    low: float = 1e-6,
    high: float = 0.3,
    steps: int = 600,
    on_step: Callable[[], None] = lambda: None,
) -> RangeTest:
    """Train one network for `steps` batches at rates from `low` to `high`, in equal factors.

    Raises:
        ParameterError: the rates or the steps are out of range.
        DatasetError: there are no inputs, or no step had a finite loss.
    """
    if not 0 < low < high <= 10 or not 20 <= steps <= 100_000:
        raise ParameterError(
            f"rates {low} to {high} in {steps} steps", valid="0 < low < high <= 10, 20 to 100000 steps"
        )
    source, wanted = as_tensors(inputs, targets)
    rates, losses = [], []
    mean, least, diverged = 0.0, math.inf, False
    generator = np.random.default_rng(options.seed)
    with single_thread(options.seed):
        network = networks.build(architecture, options.dropout)
        optimizer = adam(network, options)
        for step, rate in enumerate(np.geomspace(low, high, steps).tolist()):
            optimizer.param_groups[0]["lr"] = rate
            rows = generator.integers(len(source), size=options.batch)
            loss = train_step(network, optimizer, source[rows], wanted[rows])
            on_step()
            mean = SMOOTHING * mean + (1 - SMOOTHING) * loss
            smooth = mean / (1 - SMOOTHING ** (step + 1))
            if not math.isfinite(smooth):
                diverged = True
                break
            rates.append(rate)
            losses.append(smooth)
            # The first batches' mean is too noisy to compare with.
            least = min(least, smooth) if step >= 20 else least
            if smooth > DIVERGED * least:
                diverged = True
                break
    if len(losses) < 3:
        raise DatasetError("the loss diverges at the lowest rates", valid="a lower rate, smaller targets")
    settled = min(20, len(losses) // 4)
    best = settled + int(np.argmin(losses[settled:]))
    # Before the least: after it the loss may fall again from a height that it jumped to.
    slope = np.gradient(np.array(losses), np.log(np.array(rates)))
    steepest = settled + int(np.argmin(slope[settled : best + 1]))
    return RangeTest(tuple(rates), tuple(losses), rates[steepest], rates[best], diverged)
