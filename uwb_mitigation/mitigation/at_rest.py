"""Running median of the predicted errors of pairs of radios at rest.

Noise of the CIR changes the prediction of the network: on the EVK1000 logs, the standard deviation of static ranges is 0.022 m
before the correction and 0.048 m after it. The predictions of a pair at rest are repeated measurements of one error.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.preprocessing import Scaling

LENGTH, MIN_ALIKE = 10, 8
"""Number of the latest ranges of a pair, and how many of them must agree with the newest one."""

MAX_CHANGE_M = 0.2
MIN_CORRELATION = 0.98
"""Smallest correlation of two CIRs behind the first path. At rest 75 % of the ranges of the EVK1000 logs have another median;
2 of 30,010 ranges of simulated drives at 0.5 m/s have one."""

FIRST_TAP, TAPS_TOGETHER = 9, 3
"""Where the CIR behind the first path begins. Sums of three taps hardly depend on the phase of sampling."""

MIN_TAPS = 100
"""Shorter windows do not show whether two CIRs are the same."""

MAX_PAIRS = 1024


class PairsAtRest:
    """The latest ranges of all pairs. Not thread-safe."""

    def __init__(self) -> None:
        self._pairs: dict[tuple[int, int], deque[tuple[float, float, float, NDArray[np.float32]]]] = {}

    def apply(
        self,
        ids: tuple[NDArray[np.uint64], NDArray[np.uint64]],
        range_m: NDArray[np.floating],
        windows: NDArray[np.float32],
        scaling: Scaling,
        predicted_m: NDArray[np.float32],
    ) -> None:
        """Replace the predicted errors of pairs at rest with medians.

        Args:
            ids: of tags and anchors, each (n,).
            range_m: measured ranges, m, (n,).
            windows: inputs of the network, (n, K).
            scaling: of the windows.
            predicted_m: predicted errors, m, (n,), which are changed; NaN: the network failed.
        """
        if windows.shape[1] < MIN_TAPS:
            return
        columns = (*(column.tolist() for column in ids), range_m.tolist(), predicted_m.tolist())
        roots = windows if scaling is Scaling.PREAMBLE else np.sqrt(windows)
        end = windows.shape[1] - (windows.shape[1] - FIRST_TAP) % TAPS_TOGETHER
        behind = roots[:, FIRST_TAP:end].reshape(len(windows), -1, TAPS_TOGETHER)
        shapes = np.add.reduce(behind, axis=2)
        for row, (tag, anchor, measured_m, predicted, shape) in enumerate(zip(*columns, shapes, strict=True)):
            if predicted != predicted:
                continue
            latest = self._pairs.get((tag, anchor))
            if latest is None:
                if len(self._pairs) >= MAX_PAIRS:
                    self._pairs.clear()
                latest = self._pairs[tag, anchor] = deque(maxlen=LENGTH)
            energy = float(shape.dot(shape))
            # A copy, because a row keeps its whole batch in memory.
            latest.append((measured_m, predicted, energy, shape.copy()))
            near = [item for item in latest if -MAX_CHANGE_M <= item[0] - measured_m <= MAX_CHANGE_M]
            spare, alike = len(near) - MIN_ALIKE, list[float]()
            # The oldest ones first: if the tag moves, they differ most.
            for _, other_predicted, other_energy, other in near:
                if spare < 0:
                    break
                if float(shape.dot(other)) >= MIN_CORRELATION * math.sqrt(energy * other_energy):
                    alike.append(other_predicted)
                else:
                    spare -= 1
            if spare >= 0:
                predicted_m[row] = sorted(alike)[len(alike) // 2]
