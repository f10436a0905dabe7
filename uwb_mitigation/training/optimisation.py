"""Graph optimisation by ONNX Runtime, saved as a file (paper, section II-B: nodes removed, layers fused)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.model.bundle import session_options

_CHUNK = 1024


def optimise_file(source: Path, target: Path) -> None:
    """Write the optimised graph of an ONNX file.

    The optimisations are those that do not depend on the processor, so that the file runs on another.

    Raises:
        ModelError: ONNX Runtime refuses the model, or the file cannot be written.
    """
    options = session_options()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    options.optimized_model_filepath = str(target)
    try:
        onnxruntime.InferenceSession(str(source), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors share no narrower base.
        raise ModelError(f"cannot be optimised: {error}", where=str(source)) from error


def predict_file_m(
    model: Path, inputs: NDArray[np.float32], *, as_it_is: bool = False
) -> NDArray[np.float32]:
    """Outputs of an ONNX file, float32 (n,), for inputs (n, K).

    Args:
        as_it_is: run the nodes that the file holds, without fusing any. An int8 network needs the fusion.

    Raises:
        ModelError: ONNX Runtime refuses the model.
    """
    options = session_options()
    if as_it_is:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ModelError(f"ONNX Runtime refuses the model: {error}", where=str(model)) from error
    name = session.get_inputs()[0].name
    parts = [
        session.run(None, {name: inputs[start : start + _CHUNK, None, :]})[0][:, 0]
        for start in range(0, len(inputs), _CHUNK)
    ]
    outputs: NDArray[np.float32] = np.concatenate(parts) if parts else np.zeros(0, np.float32)
    return outputs
