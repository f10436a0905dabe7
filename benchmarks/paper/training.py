"""Train networks of one shape and several seeds together, and the steps of the paper that need the training loop.

These are the range test of the learning rate (section III-B), pruning (section II-B), and the self-attention of the original network.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import prune

from benchmarks.paper.results import RangeTest
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Mlp, Remnet
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit.fitting import Adam, single_thread
from uwb_mitigation.training.fit.options import FitOptions

ATTENTION_REDUCTION = 8
"""Ratio of channels to hidden units of the self-attention; public implementations of the original network use it."""

RANGE_TEST_RATES = np.geomspace(1e-6, 1.0, 1000)
SMOOTHING = 0.02
"""Weight of the newest loss in the running mean of the range test."""

UNCHANGED = 100
"""First steps of the range test, in which the rates are too low to change the network."""

_BATCH = 1024


class NetworkStack(nn.Module):
    """Networks of one shape as one: each layer is a grouped convolution with one group per network.

    Networks of this size wait for memory and the interpreter more than for the processor: five together take half of the time.

    Args:
        architecture: shape of each network.
        seeds: number of networks, with random weights from the seeds 0, 1, ...
        dropout: dropout rate of the head's inputs; only for REMNet.
        attention: scale the residual of each module before the sum, as the original network does (Angarano et al. 2021). The
            paper contains no details of it: squeeze and excitation (Hu et al. 2018), its position and its ratio are those of
            public implementations.
    """

    def __init__(self, architecture: Architecture, seeds: int, dropout: float, *, attention: bool = False):
        super().__init__()
        self.architecture, self.seeds = architecture, seeds
        self._generators = [torch.Generator().manual_seed(seed) for seed in range(seeds)]
        if isinstance(architecture, Mlp):
            layers = {dense.name: self._layer(dense.inputs, dense.outputs) for dense in architecture.layers}
            head, dropout = self._layer(architecture.features, 1), 0.0
        else:
            layers = {
                # PyTorch does not allow dots in module names.
                layer.name.replace(".", "_"): self._layer(
                    layer.inputs, layer.filters, layer.kernel, layer.stride, layer.padding
                )
                for layer in architecture.layers
            }
            head = self._layer(architecture.filters, 1, architecture.lengths[-1])
        self.layers, self.head, self.dropout = nn.ModuleDict(layers), head, nn.Dropout(dropout)
        # Like the trainer of the package: initially, nothing is corrected.
        nn.init.zeros_(self.head.weight)
        self.attention = nn.ModuleDict()
        if attention and isinstance(architecture, Remnet):
            filters, hidden = architecture.filters, max(architecture.filters // ATTENTION_REDUCTION, 1)
            for module in range(1, architecture.modules + 1):
                squeeze, excite = self._layer(filters, hidden), self._layer(hidden, filters)
                self.attention[f"module{module}"] = nn.Sequential(
                    nn.AdaptiveAvgPool2d(1), squeeze, nn.ReLU(), excite, nn.Sigmoid()
                )
        # The memory format in which grouped convolutions are fast.
        self.to(memory_format=torch.channels_last)

    def _layer(
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, padding: tuple[int, int] = (0, 0)
    ) -> nn.Sequential | nn.Conv2d:
        n, (left, right) = self.seeds, padding
        layer = nn.Conv2d(n * inputs, n * outputs, (1, kernel), (1, stride), (0, left), groups=n)
        # Defaults of Keras, which the paper used.
        nn.init.zeros_(layer.bias)
        for weight, generator in zip(layer.weight.detach().split(outputs), self._generators, strict=True):
            nn.init.xavier_uniform_(weight, generator=generator)
        # 'Same' padding has a zero more after the values than before, or as many.
        return nn.Sequential(nn.ZeroPad2d((0, right - left, 0, 0)), layer) if right > left else layer

    def forward(self, inputs: Tensor) -> Tensor:
        """Return outputs (n, networks) for inputs (n, networks, K)."""
        if isinstance(self.architecture, Mlp):
            values = inputs.flatten(1)[:, :, None, None]
            for name in self.layers:
                values = self._activate(name, values)
        else:
            values = self._activate("first", inputs[:, :, None, :])
            for module in (f"module{number}" for number in range(1, self.architecture.modules + 1)):
                residual = self._activate(f"{module}_residual", values)
                if module in self.attention:
                    residual = residual * self.attention[module](residual)
                values = values + residual
                values = self._activate(f"{module}_reduce", values) + self._activate(f"{module}_skip", values)
        outputs: Tensor = self.head(self.dropout(values))[:, :, 0, 0]
        return outputs

    def _activate(self, name: str, values: Tensor) -> Tensor:
        return functional.relu(self.layers[name](values), inplace=True)

    def convolutions(self) -> dict[str, nn.Conv2d]:
        """Return {layer: its convolution}, with the names of the architecture, without self-attention."""
        layers = {
            name.replace("_", "."): next(part for part in layer.modules() if isinstance(part, nn.Conv2d))
            for name, layer in self.layers.items()
        }
        return {**layers, HEAD: self.head}

    def weights_of(self, seed: int) -> FloatWeights:
        """Return a copy of the parameters of one network, without self-attention."""
        weight, bias = {}, {}
        for name, layer in self.convolutions().items():
            values = layer.weight.detach().chunk(self.seeds)[seed][:, :, 0].numpy()
            if name == HEAD:
                values = values.reshape(-1, 1)
            elif isinstance(self.architecture, Mlp):
                values = values[:, :, 0]
            weight[name] = values.copy()
            bias[name] = layer.bias.detach().chunk(self.seeds)[seed].numpy().copy()
        return FloatWeights(self.architecture, weight, bias)

    def fit(
        self,
        data: Dataset,
        options: FitOptions,
        rates: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float32]:
        """Fit the networks by mean absolute error, each with its own order of the data and its own dropout.

        Args:
            data: training part.
            options: options of Adam, batch size and seed.
            rates: learning rate of each step; by default `options.epochs` passes with the rate in `options`.

        Returns:
            Loss of each step and network, m, (steps, networks).

        Raises:
            DatasetError: a loss is not finite; not with `rates`, which may be too high.
        """
        source, targets = torch.tensor(data.inputs), torch.tensor(data.error_m, dtype=torch.float32)
        steps = -(-len(source) // options.batch)
        is_range_test = rates is not None
        if rates is None:
            rates = np.full(options.epochs * steps, options.learning_rate)
        losses = []
        with single_thread(options.seed):
            optimizer = Adam(self.parameters(), options.weight_decay)
            for step, rate in enumerate(rates.tolist()):
                if step % steps == 0:
                    self.train()
                    order = torch.stack([torch.randperm(len(source)) for _ in range(self.seeds)], 1)
                rows = order[step % steps * options.batch :][: options.batch]
                loss = (self(source[rows]) - targets[rows]).abs().mean(0)
                loss.sum().backward()
                optimizer.step(rate)
                losses.append(loss.detach().numpy())
                if step % steps == steps - 1 and not (is_range_test or np.isfinite(losses[-1]).all()):
                    raise DatasetError("the loss diverges", valid="a lower learning rate")
        return np.stack(losses)

    def predict_m(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return outputs (networks, n), m, for inputs (n, K)."""
        self.eval()
        with single_thread(0), torch.no_grad():
            batches = torch.tensor(inputs)[:, None].split(_BATCH)
            outputs = [self(batch.expand(-1, self.seeds, -1)) for batch in batches]
        predicted: NDArray[np.float32] = torch.cat(outputs).T.numpy()
        return predicted

    def maes_m(self, data: Dataset) -> list[float]:
        """Return the MAE after the correction by each network, m."""
        maes: list[float] = np.abs(data.error_m - self.predict_m(data.inputs)).mean(axis=1).tolist()
        return maes

    def mask_smallest(self, share: float) -> None:
        """Prune the `share` of the weights with the smallest magnitudes of each network; `fix_pruned` ends it."""
        layers = self.convolutions().values()
        magnitudes = [layer.weight.detach().abs().chunk(self.seeds) for layer in layers]
        limits = [
            torch.quantile(torch.cat([layer.flatten() for layer in network]), share)
            for network in zip(*magnitudes, strict=True)
        ]
        for layer, networks in zip(layers, magnitudes, strict=True):
            mask = torch.cat([weight > limit for weight, limit in zip(networks, limits, strict=True)])
            prune.custom_from_mask(layer, "weight", mask)

    def fix_pruned(self) -> int:
        """Set the masked weights to zero, remove the masks, and return the number of masked weights of one network."""
        masked = sum(int((layer.weight_mask == 0).sum()) for layer in self.convolutions().values())
        for layer in self.convolutions().values():
            prune.remove(layer, "weight")
        return masked // self.seeds


def range_test(data: Dataset, options: FitOptions, seeds: int) -> RangeTest:
    """Run the range test of the learning rate (Smith 2017): increase it with every batch and record the mean loss of `seeds` REMNets."""
    stack = NetworkStack(Remnet(data.preprocessing.samples), seeds, options.dropout)
    losses = stack.fit(data, options, RANGE_TEST_RATES).mean(axis=1)
    smooth = pd.Series(losses).ewm(alpha=SMOOTHING).mean().to_numpy()
    # Single losses of the first steps are noise.
    start, tested, rates = losses[:UNCHANGED].mean(), smooth[UNCHANGED:], RANGE_TEST_RATES[UNCHANGED:]
    decrease = start - np.nanmin(tested)
    finite = np.isfinite(smooth)
    return RangeTest(
        rates=tuple(RANGE_TEST_RATES[finite].tolist()),
        losses_m=tuple(smooth[finite].tolist()),
        falls_from=float(rates[np.argmax(tested < start - 0.1 * decrease)]),
        falls_to=float(rates[np.argmax(tested < start - 0.9 * decrease)]),
    )
