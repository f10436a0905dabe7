"""Integer constants that reproduce the float requantisation of ONNX Runtime exactly.

ONNX Runtime (MLAS) computes, in float32:

- after a convolution or a dense layer: `clip(rint(acc * s), 0, 255)`, `s = fl(fl(x * w) / y)` of the
  scales of input, weight and output;
- a sum of two uint8 tensors: `clip(rint(fma(a, ra, fl(rb * b))), 0, 255)`, `ra = fl(sa / sy)`, `rb = fl(sb / sy)`.
  Its NEON kernel for ARM computes the sum in integers instead: see `neon_sum_table`.

`rint` rounds half to even. Each function of integers has at most 255 steps, so a line with suitable
integer constants gives the same function:

- `clip(((acc + bias) * multiplier >> 32) + offset >> REQUANTISATION_SHIFT, 0, 255)`: SMMLA, then USAT with its shift.
  Bias and offset together are finer than one accumulator, because `2^32 offset` is no multiple of the multiplier;
- `clip(first * a + second * b + offset >> SUM_SHIFT, 0, 255)`: two MLA, then USAT.

`solve_*` search for such constants and return None if they do not exist, which happens if two steps differ by less
than the line can express. `nudge_*` then change a scale by the minimum amount for which they exist. A quantiser
calls `nudge` on its result, so that the ONNX file and the C code contain the same scales.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model.weights import Int8Weights, inputs_of

BIASES = range(3 << 18, 5 << 18)
"""Biases of the firmware's accumulators. They keep the three packed sums of `uwb_conv_residual.S` positive."""

REQUANTISATION_SHIFT = 3
"""Right shift after the high word of the product: scales below 2^-4 keep 31 bits of multiplier."""

SUM_SHIFT = 22
"""Fraction bits of a sum's multipliers: 510 * 2^22 still fits 31 bits."""

_LEVELS = 255
_MAX_ULPS = 64
_UNIT = 1 << (32 + REQUANTISATION_SHIFT)
_CHUNK = 1 << 13


@dataclass(frozen=True, slots=True)
class Requantisation:
    """`clip(((acc + bias) * multiplier >> 32) + offset >> REQUANTISATION_SHIFT, 0, 255)`."""

    bias: int
    multiplier: int
    offset: int


@dataclass(frozen=True, slots=True)
class Sum:
    """`clip(first * a + second * b + offset >> SUM_SHIFT, 0, 255)`."""

    first: int
    second: int
    offset: int

    def table(self) -> NDArray[np.uint8]:
        """Return the result for every a (rows) and b (columns), uint8 of shape (256, 256)."""
        a = np.arange(256, dtype=np.int64)[:, None]
        b = np.arange(256, dtype=np.int64)[None, :]
        total = (self.first * a + self.second * b + self.offset) >> SUM_SHIFT
        return saturate(total)


def requantise(accumulator: NDArray[np.number], scale: np.float32 | NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return ONNX Runtime's requantisation of int32 values: the formula that `solve_requantisation` reproduces.

    `scale` is one factor or an array that broadcasts with `accumulator`.
    """
    return saturate(np.rint(accumulator.astype(np.float32) * scale))


def sum_table(first: np.float32, second: np.float32, *, fused: bool = True) -> NDArray[np.uint8]:
    """Return ONNX Runtime's sum for every a (rows) and b (columns), from the two ratios of scales.

    `fused`: for processors with a fused multiply-add; others also round `a * ra`.
    """
    values = np.arange(256, dtype=np.float32)
    products = np.float32(second) * values
    if fused:
        # Both terms and their sum are exact in binary64, so that one rounding to binary32 gives the fma.
        exact = values.astype(np.float64)[:, None] * np.float64(first) + products.astype(np.float64)
        total = exact.astype(np.float32)
    else:
        total = (values * np.float32(first))[:, None] + products
    return saturate(np.rint(total))


def neon_sum_table(first: np.float32, second: np.float32) -> NDArray[np.uint8] | None:
    """Return the sum of ONNX Runtime's NEON kernel (ARM) for every a (rows) and b (columns).

    The kernel scales both ratios by `2^(21 - e)`, where e is the exponent of the larger ratio, rounds them to
    integers of at most 22 bits, and rounds halves of the shifted sum up. It uses another formula, and the
    result is None, if a ratio is outside of 2^-14 to 2^8, or if the larger ratio rounds to 23 bits.
    """
    ratios = np.array([first, second], np.float32)
    if not np.all((ratios >= 2.0**-14) & (ratios < 2.0**8)):
        return None
    shift = 22 - int(np.frexp(ratios.max())[1])
    scaled = np.rint(np.ldexp(ratios, shift)).astype(np.int64)
    if scaled.max() >= 1 << 22:
        return None
    values = np.arange(256, dtype=np.int64)
    return saturate((scaled[0] * values[:, None] + scaled[1] * values + (1 << (shift - 1))) >> shift)


def requantisation_scale(
    input_scale: np.float32, weight_scale: NDArray[np.float32] | np.float32, output_scale: np.float32
) -> NDArray[np.float32]:
    """Return `fl(fl(x * w) / y)`, float32 with the shape of `weight_scale`."""
    product = np.float32(input_scale) * np.asarray(weight_scale, np.float32)
    return np.asarray(product / np.float32(output_scale), np.float32)


def _thresholds(scale: np.float32, low: int, high: int) -> NDArray[np.int64]:
    """Return the smallest accumulators that give at least k = 1, 2, ..., as long as they are in (low, high]."""
    steps = np.arange(1, _LEVELS + 1)
    # Float rounding moves a step by less than one accumulator, so three candidates are enough.
    candidates = np.floor((steps - 0.5) / np.float64(scale)).astype(np.int64)[:, None] + np.arange(-1, 3)
    candidates = np.clip(candidates, -(1 << 24), 1 << 24)
    reached = np.rint(candidates.astype(np.float32) * np.float32(scale)) >= steps[:, None]
    first = candidates[np.arange(_LEVELS), reached.argmax(axis=1)]
    return np.asarray(first[reached.any(axis=1) & (first > low) & (first <= high)], np.int64)


def solve_requantisation(scale: np.float32, low: int, high: int, bias: int = 0) -> Requantisation | None:
    """Return constants that reproduce `requantise` for every accumulator from `low` to `high`, or None.

    `low` and `high` include the `bias` of the layer, and the result replaces it. None: there are no such constants, or the
    scale is 2^-4 or more.
    """
    scale = np.float32(scale)
    nominal = float(scale) * _UNIT
    if not 1.0 <= nominal < 2**31 - 1:
        return None
    steps = _thresholds(scale, low, high)
    # Count steps from the level of `low`, which can be above 0 because of the bias.
    level = int(requantise(np.array([low]), scale)[0])
    k = np.arange(level + 1, level + 1 + len(steps), dtype=np.int64)
    # With larger values the last step is always outside of its gap.
    search_width = max(1.0, nominal / max(1, abs(low), abs(high)))
    multipliers = np.unique(np.rint(nominal + np.linspace(-search_width, search_width, 129)).astype(np.int64))
    multipliers = multipliers[(multipliers > 0) & (multipliers < 2**31)]
    for multiplier in multipliers[np.argsort(np.abs(multipliers - nominal), kind="stable")].tolist():
        # Accumulator t reaches level k when t * multiplier + intercept >= k * unit, and t - 1 does not.
        lowest = k * _UNIT - steps * multiplier
        at_least, at_most = int(lowest.max(initial=-(2**62))), int(lowest.min(initial=2**62)) + multiplier - 1
        if level > 0:
            at_least = max(at_least, level * _UNIT - low * multiplier)
        if level + len(k) < _LEVELS:
            at_most = min(at_most, (level + len(k) + 1) * _UNIT - 1 - high * multiplier)
        if at_least <= at_most and (found := _split(at_least, at_most, multiplier, bias)):
            return found
    return None


def _split(at_least: int, at_most: int, multiplier: int, bias: int) -> Requantisation | None:
    """Return bias and offset with `(new bias - bias) * multiplier + 2^32 offset` between the limits, or None."""
    for start in range(BIASES.start, BIASES.stop, _CHUNK):
        biases = np.arange(start, start + _CHUNK)
        products = (biases - bias) * multiplier
        offsets = (at_most - products) >> 32
        suitable = np.flatnonzero(products + (offsets << 32) >= at_least)
        if suitable.size:
            return Requantisation(int(biases[suitable[0]]), multiplier, int(offsets[suitable[0]]))
    return None


def solve_sum(first: np.float32, second: np.float32) -> Sum | None:
    """Return constants that reproduce `sum_table(first, second)` for all 65,536 pairs; None if none are found.

    `first` and `second`, above 0, are the ratios of the operands' scales to the result's. Also None if
    their sum exceeds 2, which needs more than 31 bits, or if fused and separate arithmetic differ.
    """
    ratios = np.array([first, second], np.float32).astype(np.float64)
    if float(ratios.sum()) > 2.0:
        return None
    table = sum_table(first, second).astype(np.int64)
    if not np.array_equal(table, sum_table(first, second, fused=False)):
        return None
    a, b = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    exact = ratios[0] * a + ratios[1] * b + 0.5
    # Only pairs next to a step can be wrong, because the coefficients differ by at most 17 * 2^-22.
    critical = np.abs(exact - np.rint(exact)) < 2.0**-9
    a, b, k = (values[critical].astype(np.int64) for values in (a, b, table))
    unit = np.int64(1) << SUM_SHIFT
    steps_around = np.arange(-16, 17)
    steps_around = steps_around[np.argsort(np.abs(steps_around), kind="stable")]
    alpha, beta = (round(ratio * int(unit)) for ratio in ratios)
    for shift in steps_around.tolist():
        base = (alpha + shift) * a - k * unit
        scaled = base[None, :] + (beta + steps_around)[:, None] * b[None, :]
        floor = np.where(k > 0, -scaled, -(2**40)).max(axis=1, initial=-(2**40))
        ceiling = np.where(k < _LEVELS, unit - 1 - scaled, 2**40).min(axis=1, initial=2**40)
        for index in np.flatnonzero(floor <= ceiling).tolist():
            offset = min(max(int(unit) // 2, int(floor[index])), int(ceiling[index]))
            best = Sum(alpha + shift, beta + int(steps_around[index]), offset)
            if np.array_equal(best.table(), table):
                return best
    return None


def accumulator_range(
    weight: NDArray[np.int8], bias: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the smallest and largest accumulator of each output for uint8 inputs; `weight` has outputs first."""
    rows = weight.reshape(len(weight), -1).astype(np.int64)
    return (bias + 255 * np.minimum(rows, 0).sum(axis=1), bias + 255 * np.maximum(rows, 0).sum(axis=1))


def nudge_weight_scale(
    input_scale: np.float32,
    weight_scale: NDArray[np.float32],
    output_scale: np.float32,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return `weight_scale` with the value of each channel moved by as few ulps as needed to be solvable.

    Raises:
        ModelError: no value within 64 ulps is solvable; the scale of the channel is then out of range.
    """
    nudged = np.array(weight_scale, np.float32)
    for channel in range(len(nudged)):
        for candidate in _neighbours(nudged[channel]):
            scale = requantisation_scale(input_scale, candidate, output_scale)
            if solve_requantisation(np.float32(scale), int(low[channel]), int(high[channel])):
                nudged[channel] = candidate
                break
        else:
            raise ModelError(
                f"no exact integer requantisation near weight scale {nudged[channel]!r} of channel {channel}",
                valid="input scale * weight scale / output scale below 1/16, accumulators below 2^23",
            )
    return nudged


def nudge_sum_scale(first: np.float32, second: np.float32, total: np.float32) -> np.float32:
    """Return the scale nearest to `total` at which the sum is solvable and equal on x86 and ARM.

    `first` and `second` are the scales of the operands. "Equal" means for all 65,536 pairs of operands.

    Raises:
        ModelError: no scale within 64 ulps meets this; the scales of the operands are then too large.
    """
    for candidate in _neighbours(total):
        ratios = np.float32(first / candidate), np.float32(second / candidate)
        neon = neon_sum_table(*ratios)
        if neon is not None and np.array_equal(neon, sum_table(*ratios)) and solve_sum(*ratios):
            return candidate
    raise ModelError(
        f"no exact integer sum near scale {total!r} of operands {first!r} and {second!r}",
        valid="scales of the operands above 1/16384 of the result's, and a sum of at most twice the result's",
    )


def nudge(weights: Int8Weights) -> Int8Weights:
    """Return `weights` with scales moved by a few ulps, so that every layer has exact integer constants.

    The integers do not change. The scales of a network that is already exact do not change either.

    Raises:
        ModelError: the integer forms cannot express a scale; the message contains the layer.
    """
    activation = dict(weights.activation_scale)
    weight_scale = dict(weights.weight_scale)
    inputs = inputs_of(weights.architecture)
    for tensor, operands in inputs.items():
        if len(operands) == 2:
            first, second = (activation[operand] for operand in operands)
            activation[tensor] = nudge_sum_scale(first, second, activation[tensor])
    for layer in (layer.name for layer in weights.architecture.layers):
        low, high = accumulator_range(weights.weight[layer], weights.bias[layer])
        try:
            weight_scale[layer] = nudge_weight_scale(
                activation[inputs[layer][0]], weight_scale[layer], activation[layer], low, high
            )
        except ModelError as error:
            raise ModelError(error.what, where=layer, valid=error.valid) from error
    return replace(weights, weight_scale=weight_scale, activation_scale=activation)


def _neighbours(value: np.float32) -> Iterator[np.float32]:
    """Yield `value` and its neighbouring float32 values, nearest first."""
    up = down = np.float32(value)
    yield up
    for _ in range(_MAX_ULPS):
        up, down = np.nextafter(up, np.float32(np.inf)), np.nextafter(down, np.float32(0))
        yield from (up, down)


def saturate(values: NDArray[np.int64] | NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the values limited to 0 to 255, as uint8."""
    return np.clip(values, 0, _LEVELS).astype(np.uint8)
