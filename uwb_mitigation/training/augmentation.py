"""How simulated inputs are varied in training, beyond what the simulator draws. What it helps is in docs/background/results.md."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uwb_mitigation.preprocessing import Scaling

DECAY_NEPERS = 0.7
"""Standard deviation by which amplitudes decay more, or less, than simulated, over 100 taps: how fast a room's echoes die
away says little of the first path, and the simulator knows a handful of environments."""

FIRST_VARIED = 12
"""Up to this tap an input stays as it is: there the first path stands."""

LOUDER_SHARE, LOUDER_DB = 0.15, 22.0
"""So many of the inputs are made louder by up to so much, which no DW1000 could be: its gain control compresses. A
model that never met such levels predicts errors of metres for them."""

OTHER_RECEIVERS = 0.5
"""Share of the inputs that are changed to those of another receiver."""

PULSE = (-0.08, 0.15)
"""Bounds of the share of a tap's amplitude that each neighbour receives: receivers differ in bandwidth."""

EARLY_TAPS = 0.7
"""First-path detectors differ by up to so many taps in either direction."""

DAMAGED_SHARE = 0.05
"""Share of these inputs that are clipped at 40 % of their maximum or more, and share of those that end early."""


def vary_channel(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Inputs (n, K), scaled by the preamble count, each with a decay of its own, some louder."""
    n, samples = inputs.shape
    # The scaling is a square root of amplitudes.
    nepers = torch.randn(n, 1, generator=generator) * DECAY_NEPERS / 100
    varied = inputs * torch.exp(0.5 * nepers * (torch.arange(samples) - FIRST_VARIED).clamp(min=0))
    is_louder = torch.rand(n, 1, generator=generator) < LOUDER_SHARE
    level_db = torch.where(is_louder, torch.rand(n, 1, generator=generator) * LOUDER_DB, torch.zeros(n, 1))
    louder: Tensor = varied * 10 ** (level_db / 40)
    return louder


def vary_receiver(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Inputs (n, K) as receivers with another pulse, another detector, clipping or short windows report them."""
    n, samples = inputs.shape

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, 1, generator=generator)

    place = torch.arange(samples) + uniform(-EARLY_TAPS, EARLY_TAPS)
    before = place.floor()
    part = place - before
    taps = [(before.long() + step).clamp(0, samples - 1) for step in (0, 1)]
    amplitude = inputs * inputs
    shifted = (1 - part) * amplitude.gather(1, taps[0]) + part * amplitude.gather(1, taps[1])
    share = uniform(*PULSE)
    padded = torch.nn.functional.pad(shifted, (1, 1), mode="replicate")
    spread = (1 - 2 * share) * shifted + share * (padded[:, :-2] + padded[:, 2:])
    limit = torch.where(uniform(0, 1) < DAMAGED_SHARE, uniform(0.4, 1.0), torch.ones(n, 1))
    clipped = torch.minimum(spread.clamp(min=0), limit * spread.amax(1, keepdim=True))
    end = torch.where(uniform(0, 1) < DAMAGED_SHARE, uniform(0.2, 1.0) * samples, torch.full((n, 1), samples))
    received = torch.where(torch.arange(samples) < end, clipped, torch.zeros(())).sqrt()
    either: Tensor = torch.where(uniform(0, 1) < OTHER_RECEIVERS, received, inputs)
    return either


def normalised(inputs: Tensor) -> Tensor:
    """Inputs (n, K), scaled by the preamble count, as `Scaling.MAX` has them."""
    amplitude = inputs * inputs
    return amplitude / amplitude.amax(1, keepdim=True)


def calibration_inputs(inputs: NDArray[np.float32], scaling: Scaling) -> NDArray[np.float32]:
    """What int8 is calibrated on: inputs scaled by the preamble count as `scaling` has them, and with levels the same
    again louder: where its activations saturate, a strong radio would be harmed."""
    if scaling is Scaling.MAX:
        amplitudes: NDArray[np.float32] = normalised(torch.from_numpy(inputs)).numpy()
        return amplitudes
    return np.concatenate([inputs, inputs * np.float32(10.0 ** (LOUDER_DB / 2.0 / 40.0))])
