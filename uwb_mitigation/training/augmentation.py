"""How simulated inputs are varied in training, beyond what the simulator draws. What it helps is in docs/evaluation.md."""

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


def vary(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Inputs (n, K), scaled by the preamble count, each with a decay of its own, some louder."""
    n, samples = inputs.shape
    # The scaling is a square root of amplitudes.
    nepers = torch.randn(n, 1, generator=generator) * DECAY_NEPERS / 100
    varied = inputs * torch.exp(0.5 * nepers * (torch.arange(samples) - FIRST_VARIED).clamp(min=0))
    is_louder = torch.rand(n, 1, generator=generator) < LOUDER_SHARE
    level_db = torch.where(is_louder, torch.rand(n, 1, generator=generator) * LOUDER_DB, torch.zeros(n, 1))
    louder: Tensor = varied * 10 ** (level_db / 40)
    return louder


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
