"""The shapes of REMNet (paper, section II-A, Fig. 2) and of its baseline."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from uwb_mitigation.errors import ParameterError, check_range

HEAD = "head"
"""Name of the dense layer after the last module, whose output is flattened channel by channel."""


@dataclass(frozen=True, slots=True)
class Convolution:
    """One convolution of the network; each is followed by a ReLU.

    Attributes:
        name: `first`, or `module1.residual`, `module1.reduce`, `module1.skip` and so on.
        inputs, filters: channels in and out.
        kernel, stride: in samples.
        length: length of its input in samples.
    """

    name: str
    inputs: int
    filters: int
    kernel: int
    stride: int
    length: int

    @property
    def output_length(self) -> int:
        """Length of its output in samples."""
        return -(-self.length // self.stride)

    @property
    def padding(self) -> tuple[int, int]:
        """Number of zeros before and after the input for 'same' padding (see `Remnet`)."""
        total = max((self.output_length - 1) * self.stride + self.kernel - self.length, 0)
        return total // 2, total - total // 2

    @property
    def weight_shape(self) -> tuple[int, ...]:
        """Shape of its weights."""
        return self.filters, self.inputs, self.kernel


@dataclass(frozen=True, slots=True)
class Dense:
    """One dense layer of the MLP, followed by a ReLU."""

    name: str
    inputs: int
    outputs: int

    @property
    def weight_shape(self) -> tuple[int, ...]:
        """Shape of its weights."""
        return self.outputs, self.inputs


class _Network(ABC):
    """Layers that are followed by the head."""

    __slots__ = ()

    @property
    def kind(self) -> str:
        """`remnet` or `mlp`."""
        return type(self).__name__.lower()

    @property
    @abstractmethod
    def layers(self) -> tuple[Convolution, ...] | tuple[Dense, ...]:
        """Every layer before the head, in the order of evaluation."""

    @property
    @abstractmethod
    def features(self) -> int:
        """Inputs of the head."""

    @property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """{layer: shape of its weights}; outputs first, except for the head."""
        return {layer.name: layer.weight_shape for layer in self.layers} | {HEAD: (self.features, 1)}

    @property
    def parameters(self) -> int:
        """Trainable parameters (paper, Table 1)."""
        biases = sum(layer.weight_shape[0] for layer in self.layers) + 1
        return sum(map(math.prod, self.weight_shapes.values())) + biases


@dataclass(frozen=True, slots=True)
class Remnet(_Network):
    """REMNet without attention: conv k0; N residual reduction modules; flatten; dense.

    Each module computes `r = relu(conv_kn(x)) + x; out = relu(conv_kn,s2(r)) + relu(conv_k1,s2(r))`
    with TensorFlow's 'same' padding: total = max((ceil(L/s) - 1) s + k - L, 0), the smaller half
    before. The module keeps F channels and reduces the length from L to ceil(L/2).

    Attributes:
        samples: input length K.
        first_kernel: k0. The paper's text says 5; its parameter counts require 3.
        kernel: kn.
        filters: F.
        modules: N.
    """

    samples: int = 157
    first_kernel: int = 3
    kernel: int = 3
    filters: int = 16
    modules: int = 3

    def __post_init__(self) -> None:
        check_range("REMNet", "samples", self.samples, 1, 1016)
        check_range("REMNet", "first_kernel", self.first_kernel, 1, 31)
        check_range("REMNet", "kernel", self.kernel, 1, 31)
        check_range("REMNet", "filters", self.filters, 1, 256)
        check_range("REMNet", "modules", self.modules, 1, 6)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Length of the input of each module, and of the output of the last one."""
        lengths = [self.samples]
        for _ in range(self.modules):
            lengths.append(-(-lengths[-1] // 2))
        return tuple(lengths)

    @property
    def layers(self) -> tuple[Convolution, ...]:
        """Every convolution in the order of evaluation: first, then residual, reduce and skip of each module."""
        f, k = self.filters, self.kernel
        layers = [Convolution("first", 1, f, self.first_kernel, 1, self.samples)]
        for number, length in enumerate(self.lengths[:-1], start=1):
            layers += [
                Convolution(f"module{number}.residual", f, f, k, 1, length),
                Convolution(f"module{number}.reduce", f, f, k, 2, length),
                Convolution(f"module{number}.skip", f, f, 1, 2, length),
            ]
        return tuple(layers)

    @property
    def features(self) -> int:
        """Inputs of the head."""
        return self.lengths[-1] * self.filters


@dataclass(frozen=True, slots=True)
class Mlp(_Network):
    """The paper's baseline: dense layers with ReLU on the window, then the head.

    The paper reports 54,401 parameters, but no layer sizes; the default has exactly this number.

    Attributes:
        samples: input length K.
        hidden: outputs of each dense layer.
    """

    samples: int = 157
    hidden: tuple[int, ...] = (240, 64, 16)

    def __post_init__(self) -> None:
        check_range("MLP", "samples", self.samples, 1, 1016)
        if not 1 <= len(self.hidden) <= 6 or not all(1 <= size <= 1024 for size in self.hidden):
            raise ParameterError(f"hidden = {self.hidden}", where="MLP", valid="1 to 6 sizes of 1 to 1024")

    @property
    def layers(self) -> tuple[Dense, ...]:
        """Every dense layer before the head, in the order of evaluation: `dense1`, `dense2`, ..."""
        sizes = (self.samples, *self.hidden)
        return tuple(Dense(f"dense{n}", *size) for n, size in enumerate(pairwise(sizes), start=1))

    @property
    def features(self) -> int:
        """Inputs of the head."""
        return self.hidden[-1]


Architecture: TypeAlias = Remnet | Mlp
