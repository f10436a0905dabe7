"""The networks as PyTorch modules, their initialisation, and the conversion of their parameters to NumPy arrays."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Convolution, Dense, Mlp
from uwb_mitigation.mitigation.model.weights import FloatWeights, evaluate


class SameConvolution(nn.Module):
    """A convolution with TensorFlow's 'same' padding and ReLU: (n, L, C) to (n, ceil(L/s), F).

    It is computed as one matrix product, channels last: with the paper's batch size of 32 the convolutions of PyTorch
    take 1.4 times as long, forward and backward.
    """

    def __init__(self, layer: Convolution) -> None:
        super().__init__()
        self.padding, self.stride = (0, 0, *layer.padding), layer.stride
        self.reach = (-(-layer.length // layer.stride) - 1) * layer.stride + 1
        # Defaults of Keras, which the paper used.
        self.weight = nn.Parameter(
            nn.init.xavier_uniform_(torch.empty(layer.filters, layer.inputs, layer.kernel))
        )
        self.bias = nn.Parameter(torch.zeros(layer.filters))

    def forward(self, values: Tensor) -> Tensor:
        padded = functional.pad(values, self.padding)
        taps = [padded[:, tap : tap + self.reach : self.stride] for tap in range(self.weight.shape[2])]
        weight = self.weight.transpose(1, 2).flatten(1)
        return functional.relu(functional.linear(torch.cat(taps, 2), weight, self.bias))


class RectifiedLinear(nn.Linear):
    """A dense layer with ReLU: (n, inputs) to (n, outputs)."""

    def forward(self, values: Tensor) -> Tensor:
        return functional.relu(super().forward(values))


class Network(nn.Module):
    """A network with random weights: (n, K) to (n,); `dropout`: share of the head's inputs that are dropped.

    Only REMNet has dropout, as in the paper.
    """

    def __init__(self, architecture: Architecture, dropout: float) -> None:
        super().__init__()
        self.architecture = architecture
        layers: dict[str, nn.Module] = {
            # PyTorch does not allow dots in module names.
            _key(layer.name): RectifiedLinear(layer.inputs, layer.outputs)
            if isinstance(layer, Dense)
            else SameConvolution(layer)
            for layer in architecture.layers
        }
        self.layers = nn.ModuleDict(layers)
        self.dropout = nn.Dropout(0.0 if isinstance(architecture, Mlp) else dropout)
        for layer in layers.values():
            if isinstance(layer, RectifiedLinear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        self.head = nn.Linear(architecture.features, 1)
        # The network refines a linear bias model, so it initially predicts no correction.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        architecture = self.architecture
        # Channels last, see `SameConvolution`.
        first = inputs if isinstance(architecture, Mlp) else inputs[:, :, None]
        values = evaluate(architecture, first, self._apply_layer, lambda name, a, b: a + b)
        *_, last = values.values()
        flat = last if isinstance(architecture, Mlp) else last.transpose(1, 2).flatten(1)
        return self.head(self.dropout(flat))[:, 0]

    def _apply_layer(self, name: str, values: Tensor) -> Tensor:
        return self.layers[_key(name)](values)


def weights_of(network: Network) -> FloatWeights:
    """Return a copy of the parameters."""
    weight, bias = {}, {}
    layers = {layer.name: network.layers[_key(layer.name)] for layer in network.architecture.layers}
    for name, layer in (layers | {HEAD: network.head}).items():
        values = layer.weight.detach().numpy()
        weight[name] = (values.T if name == HEAD else values).copy()
        bias[name] = layer.bias.detach().numpy().copy()
    return FloatWeights(network.architecture, weight, bias)


def _key(layer: str) -> str:
    return layer.replace(".", "_")
