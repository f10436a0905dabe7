"""Integer constants that equal the float requantisation of ONNX Runtime for every value."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.equipment import random_networks
from uwb_mitigation.mitigation.embedded.packing import pack
from uwb_mitigation.mitigation.model import requantisation


@pytest.mark.parametrize("seed", range(20))
def test_solved_requantisation_equals_the_float_formula_on_every_accumulator(seed: int):
    random = np.random.default_rng(seed)
    scale = np.float32(10 ** random.uniform(-3.4, -1.5))
    low, high = -int(random.integers(0, 400_000)), int(random.integers(1000, 400_000))

    moved = requantisation.nudge_weight_scale(
        np.float32(1), np.array([scale]), np.float32(1), np.array([low]), np.array([high])
    )[0]
    found = requantisation.solve_requantisation(moved, low, high)

    assert found is not None
    accumulators = np.arange(low, high + 1)
    assert np.array_equal(found.apply(accumulators), requantisation.requantise(accumulators, moved))


# Every second accumulator of 1 / 64 is a tie, and even and odd levels are rounded in opposite directions.
@pytest.mark.parametrize("scale", [1 / 64, 0.07, 0, 1e-12, np.nan])
def test_ties_and_scales_out_of_range_are_not_solved(scale: float):
    low, high = (0, 20_000) if scale == 1 / 64 else (-100, 100)
    assert requantisation.solve_requantisation(np.float32(scale), low, high) is None


@pytest.mark.parametrize("seed", range(20))
def test_nudged_sum_is_equal_in_fused_separate_and_neon_arithmetic_on_every_pair(seed: int):
    random = np.random.default_rng(seed)
    first, second = (np.float32(value) for value in random.uniform(0.01, 0.1, 2))
    total = requantisation.nudge_sum_scale(first, second, np.float32((first + second) * 0.8))
    ratios = np.float32(first / total), np.float32(second / total)

    table = requantisation.solve_sum(*ratios).table()

    assert np.array_equal(table, requantisation.sum_table(*ratios))
    assert np.array_equal(table, requantisation.sum_table(*ratios, fused=False))
    assert np.array_equal(table, requantisation.neon_sum_table(*ratios))


@pytest.mark.parametrize(
    ("ratios", "pair"),
    [
        ((0.503349, 0.82120085), (241, 94)),
        ((0.852775, 0.6155854), (14, 113)),
        ((0.64466023, 0.6257859), (11, 202)),
        ((0.68119305, 0.8174464), (45, 209)),
        ((0.57772475, 0.5981696), (120, 124)),
    ],
)
def test_neon_formula_differs_where_an_arm_processor_differed(ratios, pair):
    first, second = np.float32(ratios)
    neon = requantisation.neon_sum_table(first, second)
    assert np.argwhere(neon != requantisation.sum_table(first, second)).tolist() == [list(pair)]
    # The firmware export accepts such a network: only the nudge avoids it.
    assert requantisation.solve_sum(first, second)


@pytest.mark.parametrize(
    "ratios", [(300.0, 0.5), (1e-5, 0.5), (0.0, 0.5), (np.nextafter(np.float32(1), np.float32(0)), 0.5)]
)
def test_ratios_outside_the_neon_kernel_have_no_table(ratios: tuple[float, float]):
    assert requantisation.neon_sum_table(*np.float32(ratios)) is None


@pytest.mark.parametrize("ratios", [(1.5, 0.75), (0.0, 0.5), (float("nan"), 0.5)])
def test_sums_out_of_range_are_not_solved(ratios: tuple[float, float]):
    assert requantisation.solve_sum(*np.float32(ratios)) is None


def test_nudge_makes_a_network_exportable_and_moves_no_scale_by_more_than_64_ulps():
    weights = random_networks.remnet(64, 3)
    halved = {**weights.weight_scale, "first": weights.weight_scale["first"] * np.float32(1.0009)}
    before = type(weights)(
        weights.architecture, weights.weight, halved, weights.bias, weights.activation_scale
    )

    after = requantisation.nudge(before)

    pack(after)
    for name, scale in before.weight_scale.items():
        moved = np.abs(after.weight_scale[name].view(np.int32) - scale.view(np.int32))
        assert moved.max() <= 64
        assert np.array_equal(after.weight[name], before.weight[name])
