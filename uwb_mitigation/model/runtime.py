"""Runs a bundle's network with ONNX Runtime, one thread, on the processor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.model.bundle import Bundle


class Session:
    """Runs the network of a bundle. Not for use by two threads at once: it owns its input and output buffers."""

    def __init__(self, bundle: Bundle) -> None:
        import onnxruntime  # loaded by the bundle already

        self.bundle = bundle
        self._session = bundle.session
        self._input = np.zeros((1, 1, bundle.architecture.samples), np.float32)
        self._output = np.zeros((1, 1), np.float32)
        binding = self._session.io_binding()
        (source,), (result,) = self._session.get_inputs(), self._session.get_outputs()
        binding.bind_ortvalue_input(source.name, onnxruntime.OrtValue.ortvalue_from_numpy(self._input))
        binding.bind_ortvalue_output(result.name, onnxruntime.OrtValue.ortvalue_from_numpy(self._output))
        self._binding = binding
        # Views of the bound buffers: indexing them anew costs as much as a node of the network.
        self._window, self._result = self._input[0, 0], self._output[0]
        self._names = ([result.name], source.name)

    def predict_m(self, window: NDArray[np.float32]) -> np.float32:
        """The network's output for one input, float32 (K,), m."""
        self._window[:] = window
        self._session.run_with_iobinding(self._binding)
        output: np.float32 = self._result[0]
        return output

    def predict_batch_m(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's outputs, float32 (n,), for inputs float32 (n, K), m: the bits of `predict_m`."""
        outputs, name = self._names
        result: NDArray[np.float32] = self._session.run(outputs, {name: windows[:, None, :]})[0][:, 0]
        return result
