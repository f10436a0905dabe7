"""Runs a bundle's network with ONNX Runtime, one thread, on the processor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.model.bundle import Bundle


class Session:
    """Runs the network of a bundle."""

    def __init__(self, bundle: Bundle) -> None:
        self._session = bundle.session
        (source,), (result,) = self._session.get_inputs(), self._session.get_outputs()
        self._input, self._outputs = source.name, [result.name]

    def predict_m(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's outputs, m, float32 (n,), for inputs float32 (n, K)."""
        output: NDArray[np.float32] = self._session.run(self._outputs, {self._input: windows[:, None, :]})[0]
        return output[:, 0]
