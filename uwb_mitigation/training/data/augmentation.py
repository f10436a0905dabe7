"""Augmentation of simulated training inputs; its selected values are part of the recipe in models/universal.md."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uwb_mitigation.mitigation.preprocessing import Scaling

DECAY_NEPERS = 0.7
"""Standard deviation of the change of the amplitude decay over 100 taps: the decay of the echoes of a room contains little
information about the first path, and the simulator has only a few environments."""

FIRST_VARIED_TAP = 12
"""Taps before this one contain the first path and are not changed."""

AMPLIFIED_SHARE, MAX_GAIN_DB = 0.15, 22.0
"""Share of the inputs that are amplified, and maximum gain. No DW1000 reaches these levels, because its gain control
compresses, but a model that was not trained with them predicts errors of metres for them."""

NOISY_SHARE, NOISE_DB = 0.25, (-46.0, -32.0)
"""Share of the inputs with additional noise, and bounds of its level relative to the strongest tap: real boards differ, and
without it the network takes the noise for a sign of a weak direct path."""

OTHER_RECEIVER_SHARE = 0.5
"""Share of the inputs that are changed to imitate another receiver."""

NEIGHBOUR_SHARES = (-0.08, 0.15)
"""Bounds of the share of a tap's amplitude that is added to each neighbour: receivers differ in bandwidth."""

MAX_SHIFT_TAPS = 0.7
"""Maximum shift of the first path in either direction, taps: first-path detectors differ."""

DAMAGED_SHARE = 0.05
"""Share of these inputs that are clipped at 40 % of their maximum or more; also the share that is truncated."""


def vary_channel(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Vary the decay of each input (n, K), scaled by the preamble count, and amplify some of them."""
    n, samples = inputs.shape
    # The scaled inputs are square roots of amplitudes.
    nepers = torch.randn(n, 1, generator=generator) * DECAY_NEPERS / 100
    varied = inputs * torch.exp(0.5 * nepers * (torch.arange(samples) - FIRST_VARIED_TAP).clamp(min=0))
    is_amplified = torch.rand(n, 1, generator=generator) < AMPLIFIED_SHARE
    level_db = torch.where(
        is_amplified, torch.rand(n, 1, generator=generator) * MAX_GAIN_DB, torch.zeros(n, 1)
    )
    return varied * 10 ** (level_db / 40)


def vary_noise(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Add complex noise to the taps of some of the inputs (n, K), scaled by the preamble count."""
    n = len(inputs)
    is_noisy = torch.rand(n, 1, generator=generator) < NOISY_SHARE
    level_db = NOISE_DB[0] + (NOISE_DB[1] - NOISE_DB[0]) * torch.rand(n, 1, generator=generator)
    amplitude = inputs * inputs
    component = 10 ** (level_db / 20) * amplitude.amax(1, keepdim=True) / math.sqrt(2.0)
    # The phase of a tap does not matter, because that of the noise is uniform.
    real = amplitude + component * torch.randn(inputs.shape, generator=generator)
    imaginary = component * torch.randn(inputs.shape, generator=generator)
    return torch.where(is_noisy, torch.hypot(real, imaginary).sqrt(), inputs)


def vary_receiver(inputs: Tensor, generator: torch.Generator) -> Tensor:
    """Change inputs (n, K) to those of receivers with another pulse or detector, clipping or short windows."""
    n, samples = inputs.shape

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, 1, generator=generator)

    position = torch.arange(samples) + uniform(-MAX_SHIFT_TAPS, MAX_SHIFT_TAPS)
    lower = position.floor()
    fraction = position - lower
    taps = [(lower.long() + step).clamp(0, samples - 1) for step in (0, 1)]
    amplitude = inputs * inputs
    shifted = (1 - fraction) * amplitude.gather(1, taps[0]) + fraction * amplitude.gather(1, taps[1])
    neighbour_share = uniform(*NEIGHBOUR_SHARES)
    padded = torch.nn.functional.pad(shifted, (1, 1), mode="replicate")
    filtered = (1 - 2 * neighbour_share) * shifted + neighbour_share * (padded[:, :-2] + padded[:, 2:])
    limit = torch.where(uniform(0, 1) < DAMAGED_SHARE, uniform(0.4, 1.0), torch.ones(n, 1))
    clipped = torch.minimum(filtered.clamp(min=0), limit * filtered.amax(1, keepdim=True))
    end = torch.where(uniform(0, 1) < DAMAGED_SHARE, uniform(0.2, 1.0) * samples, torch.full((n, 1), samples))
    received = torch.where(torch.arange(samples) < end, clipped, torch.zeros(())).sqrt()
    return torch.where(uniform(0, 1) < OTHER_RECEIVER_SHARE, received, inputs)


def normalised(inputs: Tensor) -> Tensor:
    """Convert inputs (n, K) that are scaled by the preamble count to `Scaling.MAX`."""
    amplitude = inputs * inputs
    return amplitude / amplitude.amax(1, keepdim=True)


def scaled_calibration_inputs(inputs: NDArray[np.float32], scaling: Scaling) -> NDArray[np.float32]:
    """Convert inputs that are scaled by the preamble count to `scaling` for int8 calibration.

    With levels, amplified copies are appended, so that the activations do not saturate with a strong radio.
    """
    if scaling is Scaling.MAX:
        return np.asarray(normalised(torch.from_numpy(inputs)).numpy(), np.float32)
    return np.concatenate([inputs, inputs * np.float32(10.0 ** (MAX_GAIN_DB / 2.0 / 40.0))])
