"""The networks as PyTorch modules, their initialisation, and the conversion of their parameters to NumPy arrays."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Convolution, Mlp, Remnet
from uwb_mitigation.mitigation.model.weights import FloatWeights


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


class RemnetModule(nn.Module):
    """The network of `Remnet`: (n, K) to (n,); `dropout`: share of the head's inputs that are dropped."""

    def __init__(self, architecture: Remnet, dropout: float) -> None:
        super().__init__()
        self.architecture = architecture
        # PyTorch does not allow dots in module names.
        self.layers = nn.ModuleDict(
            {_key(layer.name): SameConvolution(layer) for layer in architecture.convolutions}
        )
        self.dropout = nn.Dropout(dropout)
        self.head = _head(architecture.features)

    def forward(self, inputs: Tensor) -> Tensor:
        values = self.layers["first"](inputs[:, :, None])
        for module in range(1, self.architecture.modules + 1):
            prefix = f"module{module}"
            summed = self.layers[_key(f"{prefix}.residual")](values) + values
            values = self.layers[_key(f"{prefix}.reduce")](summed)
            values = values + self.layers[_key(f"{prefix}.skip")](summed)
        output: Tensor = self.head(self.dropout(values.transpose(1, 2).flatten(1)))[:, 0]
        return output

    def by_name(self) -> dict[str, nn.Module]:
        """Return {layer: module with its weights and bias}."""
        layers = {layer.name: self.layers[_key(layer.name)] for layer in self.architecture.convolutions}
        return {**layers, HEAD: self.head}


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

    def by_name(self) -> dict[str, nn.Module]:
        """Return {layer: module with its weights and bias}."""
        return {**self.layers, HEAD: self.head}


Network = RemnetModule | MlpModule


def build_network(architecture: Architecture, dropout: float, start: FloatWeights | None = None) -> Network:
    """Return a network with random weights or with those of `start`. Only REMNet has dropout, as in the paper."""
    network = (
        MlpModule(architecture) if isinstance(architecture, Mlp) else RemnetModule(architecture, dropout)
    )
    if start is not None:
        with torch.no_grad():
            for name, layer in network.by_name().items():
                weight = torch.from_numpy(start.weight[name])
                layer.weight.copy_(weight.T if name == HEAD else weight)
                layer.bias.copy_(torch.from_numpy(start.bias[name]))
    return network


def weights_of(network: Network) -> FloatWeights:
    """Return a copy of the parameters."""
    weight, bias = {}, {}
    for name, layer in network.by_name().items():
        values = layer.weight.detach().numpy()
        weight[name] = (values.T if name == HEAD else values).copy()
        bias[name] = layer.bias.detach().numpy().copy()
    return FloatWeights(network.architecture, weight, bias)


def _head(features: int) -> nn.Linear:
    head = nn.Linear(features, 1)
    # The network refines a linear bias model, so it initially predicts no correction.
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


def _key(layer: str) -> str:
    return layer.replace(".", "_")
