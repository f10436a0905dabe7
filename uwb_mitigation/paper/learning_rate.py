"""The learning-rate range test (Smith 2017): increase the rate with every batch and record the loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.model.architecture import Architecture
from uwb_mitigation.training import fitting, networks
from uwb_mitigation.training.options import FitOptions

SMOOTHING = 0.95
"""Weight of the past in the running mean of the losses."""

DIVERGED = 4.0
"""The test ends when the smoothed loss exceeds this multiple of its minimum."""

SETTLING = 20
"""Steps before the running mean is reliable."""


@dataclass(frozen=True, slots=True)
class RangeTest:
    """Result of a range test.

    Attributes:
        rates, losses_m: of each step; losses are smoothed mean absolute errors.
        suggested: the rate at which the loss falls steepest over the logarithm of the rate.
        highest: the rate with the smallest loss.
        diverged: the loss exploded before the last rate.
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
        DatasetError: no inputs, or no step has a finite loss.
    """
    if not 0 < low < high <= 10 or not SETTLING <= steps <= 100_000:
        raise ParameterError(
            f"rates {low} to {high} in {steps} steps", valid="0 < low < high <= 10, 20 to 100000 steps"
        )
    source, wanted = fitting.as_tensors(inputs, targets)
    rates: list[float] = []
    losses: list[float] = []
    mean, least, diverged = 0.0, math.inf, False
    generator = np.random.default_rng(options.seed)
    with fitting.single_thread(options.seed):
        network = networks.build(architecture, options.dropout)
        optimizer = fitting.adam(network, options)
        for step, rate in enumerate(np.geomspace(low, high, steps).tolist()):
            optimizer.param_groups[0]["lr"] = rate
            rows = generator.integers(len(source), size=options.batch)
            loss = fitting.step(network, optimizer, source[rows], wanted[rows])
            on_step()
            mean = SMOOTHING * mean + (1 - SMOOTHING) * loss
            smooth = mean / (1 - SMOOTHING ** (step + 1))
            if math.isfinite(smooth):
                rates.append(rate)
                losses.append(smooth)
                least = min(least, smooth) if step >= SETTLING else least
            if not math.isfinite(smooth) or smooth > DIVERGED * least:
                diverged = True
                break
    if len(losses) < 3:
        raise DatasetError("the loss diverges at the lowest rates", valid="a lower rate, smaller targets")
    settled = min(SETTLING, len(losses) // 4)
    best = settled + int(np.argmin(losses[settled:]))
    # Search before the minimum: after it the loss may fall again from a peak.
    slope = np.gradient(np.array(losses), np.log(np.array(rates)))
    steepest = settled + int(np.argmin(slope[settled : best + 1]))
    return RangeTest(tuple(rates), tuple(losses), rates[steepest], rates[best], diverged)
