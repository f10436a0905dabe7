"""REMNet in torch, and its parameters as numpy arrays."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from uwb_mitigation.model.architecture import HEAD, Convolution, Remnet
from uwb_mitigation.model.weights import FloatWeights


class SameConvolution(nn.Module):
    """A convolution with 'same' padding as TensorFlow's, and its ReLU."""

    def __init__(self, layer: Convolution) -> None:
        super().__init__()
        self.padding = layer.padding
        self.convolution = nn.Conv1d(layer.inputs, layer.filters, layer.kernel, layer.stride)
        # Keras's defaults, which the paper trained with.
        nn.init.xavier_uniform_(self.convolution.weight)
        nn.init.zeros_(self.convolution.bias)

    def forward(self, values: Tensor) -> Tensor:
        return functional.relu(self.convolution(functional.pad(values, self.padding)))


class RemnetModule(nn.Module):
    """The network of `Remnet`: (n, K) to (n,)."""

    def __init__(self, architecture: Remnet, dropout: float) -> None:
        super().__init__()
        self.architecture = architecture
        # Module names hold no dots.
        self.layers = nn.ModuleDict(
            {_key(layer.name): SameConvolution(layer) for layer in architecture.convolutions}
        )
        self.dropout = nn.Dropout(dropout)
        self.head = nn.Linear(architecture.features, 1)
        # It corrects what a prior leaves: it starts from no correction.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        values = self.layers["first"](inputs[:, None, :])
        for module in range(1, self.architecture.modules + 1):
            prefix = f"module{module}"
            summed = self.layers[_key(f"{prefix}.residual")](values) + values
            values = self.layers[_key(f"{prefix}.reduce")](summed)
            values = values + self.layers[_key(f"{prefix}.skip")](summed)
        output: Tensor = self.head(self.dropout(values.flatten(1)))[:, 0]
        return output

    def weights(self) -> FloatWeights:
        """A copy of the parameters."""
        weight, bias = {}, {}
        for layer in self.architecture.convolutions:
            convolution = self.layers[_key(layer.name)].convolution
            weight[layer.name] = convolution.weight.detach().numpy().copy()
            bias[layer.name] = convolution.bias.detach().numpy().copy()
        weight[HEAD] = self.head.weight.detach().numpy().T.copy()
        bias[HEAD] = self.head.bias.detach().numpy().copy()
        return FloatWeights(self.architecture, weight, bias)


def _key(layer: str) -> str:
    return layer.replace(".", "_")
