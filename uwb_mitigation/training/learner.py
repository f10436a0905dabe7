"""One step of training: loss, gradients, and Adam's update.

`RemnetLearner` computes REMNet's gradients by hand, as products of matrices on buffers that are laid out
once, with time before channels. At the paper's batch of 32 torch's own convolutions spend most of their time
on anything but arithmetic; `uwb-mitigation bench training` measures both. The gradients are those of
`RemnetModule` up to rounding.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor, nn

from uwb_mitigation.model.architecture import HEAD, Architecture, Convolution, Remnet
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import networks
from uwb_mitigation.training.options import FitOptions

BETAS = (0.9, 0.999)
EPSILON = 1e-8
"""Of Adam (paper, section III-B)."""


class Adam:
    """Adam with decoupled weight decay, as `torch.optim.AdamW`, whose import alone takes seconds."""

    def __init__(self, parameters: list[Tensor], options: FitOptions) -> None:
        self.learning_rate = options.learning_rate
        self._decay = options.weight_decay
        self._states = [(values, torch.zeros_like(values), torch.zeros_like(values)) for values in parameters]
        self._steps = 0

    def step(self, gradients: list[Tensor]) -> None:
        """Update the parameters in place by gradients in the same order."""
        self._steps += 1
        first, second = 1 - BETAS[0] ** self._steps, 1 - BETAS[1] ** self._steps
        with torch.no_grad():
            for (values, mean, square), gradient in zip(self._states, gradients, strict=True):
                values.mul_(1 - self.learning_rate * self._decay)
                mean.lerp_(gradient, 1 - BETAS[0])
                square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
                spread = square.sqrt().div_(math.sqrt(second)).add_(EPSILON)
                values.addcdiv_(mean, spread, value=-self.learning_rate / first)


class Learner(Protocol):
    """A network in training."""

    optimizer: Adam

    def step(self, inputs: Tensor, targets: Tensor) -> float:
        """Update the network by one batch, (n, K) and (n,); returns the mean absolute error before, m."""

    def weights(self) -> FloatWeights:
        """A copy of the parameters."""


def learner(architecture: Architecture, options: FitOptions, start: FloatWeights | None = None) -> Learner:
    """A network with fresh weights, drawn from torch's generator, or with those of `start`."""
    if isinstance(architecture, Remnet):
        if start is None:
            start = networks.RemnetModule(architecture, 0).weights()
        return RemnetLearner(start, options)
    return ModuleLearner(networks.build(architecture, options.dropout), options)


class ModuleLearner:
    """Trains a torch module, (n, K) to (n,), with torch's gradients."""

    def __init__(self, module: nn.Module, options: FitOptions) -> None:
        self.module = module.train()
        self._parameters = list(module.parameters())
        self.optimizer = Adam([values.detach() for values in self._parameters], options)

    def step(self, inputs: Tensor, targets: Tensor) -> float:
        loss = torch.nn.functional.l1_loss(self.module(inputs), targets)
        self.optimizer.step(list(torch.autograd.grad(loss, self._parameters)))
        return float(loss.item())

    def weights(self) -> FloatWeights:
        weights: FloatWeights = self.module.weights()
        return weights


class RemnetLearner:
    """Trains a REMNet from given weights."""

    def __init__(self, weights: FloatWeights, options: FitOptions) -> None:
        if not isinstance(weights.architecture, Remnet):
            raise TypeError(f"weights of {type(weights.architecture).__name__}")
        self.architecture = weights.architecture
        self._keep = 1 - options.dropout
        self._parameters = _Parameters(weights)
        self.optimizer = Adam([self._parameters.values], options)
        self._passes: dict[int, _Pass] = {}

    def step(self, inputs: Tensor, targets: Tensor) -> float:
        loss = self.gradients(inputs, targets)
        self.optimizer.step([self._parameters.gradient])
        return loss

    def gradients(self, inputs: Tensor, targets: Tensor) -> float:
        """Compute the loss and its gradients, which `gradient` then reads."""
        count = len(inputs)
        if count not in self._passes:
            self._passes[count] = _Pass(self.architecture, self._parameters, self._keep, count)
        with torch.no_grad():
            return self._passes[count].run(inputs, targets)

    def weights(self) -> FloatWeights:
        return self._parameters.as_weights(self._parameters.values)

    def gradient(self) -> FloatWeights:
        """The last gradients, in the place of the parameters that they are of."""
        return self._parameters.as_weights(self._parameters.gradient)


class _Parameters:
    """All parameters in one vector, and views of it: a convolution's weights as (k * C, F), taps first."""

    def __init__(self, weights: FloatWeights) -> None:
        shape = self._shape = weights.architecture
        if not isinstance(shape, Remnet):
            raise TypeError(f"weights of {type(shape).__name__}")
        self._layers = {layer.name: layer for layer in shape.convolutions}
        self._last = (shape.filters, shape.lengths[-1])
        sizes = {name: weight.size for name, weight in weights.weight.items()}
        total = sum(sizes.values()) + sum(bias.size for bias in weights.bias.values())
        self.values, self.gradient = torch.empty(total), torch.zeros(total)
        self.weight, self.bias = self._views(self.values)
        self.weight_gradient, self.bias_gradient = self._views(self.gradient)
        for name, bias in weights.bias.items():
            values = torch.from_numpy(weights.weight[name])
            layout = (
                values.view(self._last).T.reshape(-1, 1)
                if name == HEAD
                else values.permute(2, 1, 0).reshape(self.weight[name].shape)
            )
            self.weight[name].copy_(layout)
            self.bias[name].copy_(torch.from_numpy(bias))

    def _views(self, vector: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        weight, bias, start = {}, {}, 0
        shapes = {name: (layer.kernel * layer.inputs, layer.filters) for name, layer in self._layers.items()}
        shapes[HEAD] = (self._last[0] * self._last[1], 1)
        for name, (rows, columns) in shapes.items():
            weight[name] = vector[start : start + rows * columns].view(rows, columns)
            start += rows * columns
            bias[name] = vector[start : start + columns]
            start += columns
        return weight, bias

    def as_weights(self, vector: Tensor) -> FloatWeights:
        weight, bias = self._views(vector)
        arrays = {}
        for name, values in weight.items():
            if name == HEAD:
                arranged = values.view(self._last[::-1]).T.reshape(-1, 1)
            else:
                layer = self._layers[name]
                arranged = values.view(layer.kernel, layer.inputs, layer.filters).permute(2, 1, 0)
            arrays[name] = arranged.contiguous().numpy().copy()
        return FloatWeights(
            self._shape, arrays, {name: values.numpy().copy() for name, values in bias.items()}
        )


class _Columns:
    """What each output of a convolution reads, (n * steps, k * C), gathered from (n, L, C), and scattered back."""

    def __init__(self, layer: Convolution, count: int) -> None:
        steps = -(-layer.length // layer.stride)
        # The padding is zero, and no step writes to it.
        self._columns = torch.zeros(count, steps, layer.kernel, layer.inputs)
        self._gradients = torch.zeros_like(self._columns)
        self.rows = self._columns.view(count * steps, -1)
        self.gradient_rows = self._gradients.view(count * steps, -1)
        self._taps = _overlaps(layer, steps)

    def bind(self, values: Tensor, gradient: Tensor) -> None:
        """Fix where to gather from and scatter to, both (n, L, C)."""
        parts = [(tap, written, read) for tap, (written, read) in enumerate(self._taps) if read]
        self._gathers = [(self._columns[:, written, tap], values[:, read]) for tap, written, read in parts]
        self._scatters = [
            (gradient[:, read], self._gradients[:, written, tap]) for tap, written, read in parts
        ]

    def gather(self) -> None:
        for target, source in self._gathers:
            target.copy_(source)

    def scatter(self) -> None:
        for target, source in self._scatters:
            target.add_(source)


def _overlaps(layer: Convolution, steps: int) -> list[tuple[slice, slice | None]]:
    """For each tap: the outputs for which it lies inside of the input, and the inputs that it then reads."""
    overlaps: list[tuple[slice, slice | None]] = []
    for tap in range(layer.kernel):
        shift = tap - layer.padding[0]
        first = max(-(shift // layer.stride), 0)
        stop = min((layer.length - 1 - shift) // layer.stride + 1, steps)
        if stop <= first:
            overlaps.append((slice(0, 0), None))
            continue
        start = first * layer.stride + shift
        last = start + (stop - first - 1) * layer.stride
        overlaps.append((slice(first, stop), slice(start, last + 1, layer.stride)))
    return overlaps


class _Branch:
    """A convolution and its ReLU on rows of columns; `output` and `gradient` are (n * steps, F)."""

    def __init__(self, name: str, parameters: _Parameters, rows: Tensor) -> None:
        self._weight, self._bias = parameters.weight[name], parameters.bias[name]
        self._transposed = self._weight.T
        self._of_weight, self._of_bias = parameters.weight_gradient[name], parameters.bias_gradient[name]
        self._rows, self._rows_transposed = rows, rows.T
        self.output = torch.empty(len(rows), self._weight.shape[1])
        self.gradient = torch.empty_like(self.output)

    def forward(self) -> None:
        torch.addmm(self._bias, self._rows, self._weight, out=self.output).relu_()

    def backward(self, gradient: Tensor) -> None:
        """Take the gradient of the output; leave those of the parameters."""
        torch.ops.aten.threshold_backward.grad_input(gradient, self.output, 0, grad_input=self.gradient)
        torch.mm(self._rows_transposed, self.gradient, out=self._of_weight)
        torch.sum(self.gradient, 0, out=self._of_bias)

    def to_columns(self, columns: Tensor) -> None:
        """Write the gradient of the rows that were read."""
        torch.mm(self.gradient, self._transposed, out=columns)

    def add_to_columns(self, columns: Tensor) -> None:
        columns.addmm_(self.gradient, self._transposed)


class _Module:
    """A residual reduction module: (n, L, F) to (n, ceil(L/2), F)."""

    def __init__(
        self, number: int, shape: Remnet, parameters: _Parameters, count: int, values: Tensor
    ) -> None:
        layers = {layer.name: layer for layer in shape.convolutions}
        name = f"module{number}"
        length, half = shape.lengths[number - 1 : number + 1]
        self._values = values.view(-1, shape.filters)
        self._sum = torch.empty(count * length, shape.filters)
        self.input_gradient = torch.empty_like(self._sum)
        place = (count, length, shape.filters)
        self._near = _Columns(layers[f"{name}.residual"], count)
        self._near.bind(values.view(place), self.input_gradient.view(place))
        self._residual = _Branch(f"{name}.residual", parameters, self._near.rows)
        reduce = layers[f"{name}.reduce"]
        self._wide = _Columns(reduce, count)
        self._wide.bind(self._sum.view(place), self.input_gradient.view(place))
        self._reduce = _Branch(f"{name}.reduce", parameters, self._wide.rows)
        # The skip reads every other input, as one tap of the reduction does.
        middle = slice(reduce.padding[0] * shape.filters, (reduce.padding[0] + 1) * shape.filters)
        self._middle_gradient = self._wide.gradient_rows[:, middle]
        self._skip = _Branch(f"{name}.skip", parameters, self._wide.rows[:, middle])
        self.output = torch.empty(count * half, shape.filters)

    def forward(self) -> None:
        self._near.gather()
        self._residual.forward()
        torch.add(self._residual.output, self._values, out=self._sum)
        self._wide.gather()
        self._reduce.forward()
        self._skip.forward()
        torch.add(self._reduce.output, self._skip.output, out=self.output)

    def backward(self, gradient: Tensor) -> None:
        """Take the gradient of the output; leave those of the parameters, and `input_gradient`."""
        self._reduce.backward(gradient)
        self._skip.backward(gradient)
        self._reduce.to_columns(self._wide.gradient_rows)
        self._skip.add_to_columns(self._middle_gradient)
        self.input_gradient.zero_()
        self._wide.scatter()
        # Of the sum: passed on to the input as it is, and through the residual.
        self._residual.backward(self.input_gradient)
        self._residual.to_columns(self._near.gradient_rows)
        self._near.scatter()


class _Pass:
    """Forward and backward for batches of one size."""

    def __init__(self, shape: Remnet, parameters: _Parameters, keep: float, count: int) -> None:
        self._keep = keep
        first = shape.convolutions[0]
        self._inputs = torch.empty(count, shape.samples, 1)
        self._columns = _Columns(first, count)
        self._columns.bind(self._inputs, self._inputs)
        self._first = _Branch("first", parameters, self._columns.rows)
        self._modules: list[_Module] = []
        values = self._first.output
        for number in range(1, shape.modules + 1):
            self._modules.append(_Module(number, shape, parameters, count, values))
            values = self._modules[-1].output
        self._flat = values.view(count, shape.features)
        self._mask = torch.empty(count, shape.features)
        self._kept = torch.empty_like(self._mask)
        self._flat_gradient = torch.empty_like(self._mask)
        self._last_gradient = self._flat_gradient.view(values.shape)
        self._weight, self._bias = parameters.weight[HEAD], parameters.bias[HEAD]
        self._of_weight = parameters.weight_gradient[HEAD]
        self._of_bias = parameters.bias_gradient[HEAD]

    def run(self, inputs: Tensor, targets: Tensor) -> float:
        self._inputs.copy_(inputs[:, :, None])
        self._columns.gather()
        self._first.forward()
        for module in self._modules:
            module.forward()
        torch.rand(self._mask.shape, out=self._mask).lt_(self._keep).div_(self._keep)
        torch.mul(self._flat, self._mask, out=self._kept)
        difference = torch.addmm(self._bias, self._kept, self._weight)[:, 0].sub_(targets)
        gradient = difference.sign().div_(len(targets))[:, None]
        torch.mm(self._kept.T, gradient, out=self._of_weight)
        torch.sum(gradient, 0, out=self._of_bias)
        torch.mm(gradient, self._weight.T, out=self._flat_gradient).mul_(self._mask)
        below = self._last_gradient
        for module in reversed(self._modules):
            module.backward(below)
            below = module.input_gradient
        self._first.backward(below)
        return float(difference.abs_().mean())
