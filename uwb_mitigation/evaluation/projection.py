"""Principal component analysis, by the singular values of the centred data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Attributes:
    points: float64 (n, d), coordinates along the first d principal components.
    explained: float64 (d,), the share of the variance along each, 0 to 1.
    """

    points: NDArray[np.float64]
    explained: NDArray[np.float64]


def principal_components(inputs: NDArray[np.floating], dimensions: int = 3) -> Projection:
    """Project inputs of shape (n, k) onto the directions of their largest variance.

    The sign of a component is arbitrary: its largest weight is made positive, so that a picture of the same
    data is the same everywhere. Components that the data does not have are zero.
    """
    centred = inputs.astype(np.float64) - inputs.mean(axis=0, dtype=np.float64)
    _, singular, components = np.linalg.svd(centred, full_matrices=False)
    found = min(dimensions, len(components))
    components, power = components[:found], singular**2
    largest = np.abs(components).argmax(axis=1)
    components = components * np.sign(components[np.arange(found), largest])[:, None]
    points = np.zeros((len(inputs), dimensions))
    points[:, :found] = centred @ components.T
    explained = np.zeros(dimensions)
    if power.sum() > 0:
        explained[:found] = power[:found] / power.sum()
    return Projection(points, explained)
