"""The networks as torch modules, and their parameters as numpy arrays.

They define what is trained and initialise it. REMNet itself is trained by `learner`, which computes the same
gradients faster.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uwb_mitigation.model.architecture import HEAD, Architecture, Convolution, Mlp, Remnet
from uwb_mitigation.model.weights import FloatWeights

ATTENTION_REDUCTION = 8
"""Channels to hidden units of squeeze and excitation: 82 parameters a module at F = 16."""


class SameConvolution(nn.Module):
    """A convolution with 'same' padding as TensorFlow's, and its ReLU: (n, C, L) to (n, F, ceil(L/s))."""

    def __init__(self, layer: Convolution) -> None:
        super().__init__()
        self.padding = layer.padding
        self.convolution = nn.Conv1d(layer.inputs, layer.filters, layer.kernel, layer.stride)
        # Keras's defaults, which the paper trained with.
        nn.init.xavier_uniform_(self.convolution.weight)
        nn.init.zeros_(self.convolution.bias)

    def forward(self, values: Tensor) -> Tensor:
        return functional.relu(self.convolution(functional.pad(values, self.padding)))


class SqueezeExcitation(nn.Module):
    """Channel attention (Hu et al. 2018) on (n, F, L): weighs each channel by what all of them average."""

    def __init__(self, filters: int) -> None:
        super().__init__()
        hidden = max(filters // ATTENTION_REDUCTION, 1)
        self.squeeze, self.excite = nn.Linear(filters, hidden), nn.Linear(hidden, filters)
        for layer in (self.squeeze, self.excite):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, values: Tensor) -> Tensor:
        weight = torch.sigmoid(self.excite(functional.relu(self.squeeze(values.mean(2)))))
        return values * weight[:, :, None]


class RemnetModule(nn.Module):
    """The network of `Remnet`: (n, K) to (n,).

    Args:
        dropout: share of the head's inputs that are dropped.
        attention: weigh each residual by squeeze and excitation, as the original network does (Angarano et
            al. 2021); such a network is for comparison and cannot be exported.
    """

    def __init__(self, architecture: Remnet, dropout: float, *, attention: bool = False) -> None:
        super().__init__()
        self.architecture = architecture
        # Module names hold no dots.
        self.layers = nn.ModuleDict(
            {_key(layer.name): SameConvolution(layer) for layer in architecture.convolutions}
        )
        self.attention = nn.ModuleList(
            SqueezeExcitation(architecture.filters) for _ in range(architecture.modules if attention else 0)
        )
        self.dropout = nn.Dropout(dropout)
        self.head = _head(architecture.features)

    def forward(self, inputs: Tensor) -> Tensor:
        values = self.layers["first"](inputs[:, None, :])
        for module in range(1, self.architecture.modules + 1):
            prefix = f"module{module}"
            residual = self.layers[_key(f"{prefix}.residual")](values)
            if self.attention:
                residual = self.attention[module - 1](residual)
            summed = residual + values
            values = self.layers[_key(f"{prefix}.reduce")](summed)
            values = values + self.layers[_key(f"{prefix}.skip")](summed)
        output: Tensor = self.head(self.dropout(values.flatten(1)))[:, 0]
        return output

    def weights(self) -> FloatWeights:
        """A copy of the parameters; without attention only."""
        layers = {
            layer.name: self.layers[_key(layer.name)].convolution for layer in self.architecture.convolutions
        }
        return _weights(self.architecture, layers, self.head)


class MlpModule(nn.Module):
    """The network of `Mlp`: (n, K) to (n,)."""

    def __init__(self, architecture: Mlp) -> None:
        super().__init__()
        self.architecture = architecture
        self.layers = nn.ModuleDict(
            {layer.name: nn.Linear(layer.inputs, layer.outputs) for layer in architecture.layers}
        )
        for layer in self.layers.values():
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.head = _head(architecture.features)

    def forward(self, inputs: Tensor) -> Tensor:
        values = inputs
        for layer in self.layers.values():
            values = functional.relu(layer(values))
        output: Tensor = self.head(values)[:, 0]
        return output

    def weights(self) -> FloatWeights:
        """A copy of the parameters."""
        return _weights(self.architecture, dict(self.layers.items()), self.head)


def build(architecture: Architecture, dropout: float) -> RemnetModule | MlpModule:
    """A network with fresh weights; `dropout` is REMNet's alone, as in the paper."""
    return MlpModule(architecture) if isinstance(architecture, Mlp) else RemnetModule(architecture, dropout)


def _head(features: int) -> nn.Linear:
    head = nn.Linear(features, 1)
    # It corrects what a prior leaves: it starts from no correction.
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


def _weights(architecture: Architecture, layers: dict[str, nn.Module], head: nn.Linear) -> FloatWeights:
    weight = {name: layer.weight.detach().numpy().copy() for name, layer in layers.items()}
    bias = {name: layer.bias.detach().numpy().copy() for name, layer in layers.items()}
    weight[HEAD] = head.weight.detach().numpy().T.copy()
    bias[HEAD] = head.bias.detach().numpy().copy()
    return FloatWeights(architecture, weight, bias)


def _key(layer: str) -> str:
    return layer.replace(".", "_")
