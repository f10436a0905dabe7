"""The shipped model on measurements that it was not made for: it may fail to help, it must not harm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from uwb_mitigation.evaluation.outcome import evaluate
from uwb_mitigation.measurement import Cir, Encoding
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.sources.simulated import SimulatedSource
from uwb_mitigation.sources.source import Record

EVERY = 15


@pytest.fixture(scope="module")
def mitigation() -> Mitigation:
    return Mitigation(load_bundle(default_model_path()))


@pytest.fixture(scope="module")
def records(apartment_reading) -> list[Record]:
    return apartment_reading.records[::EVERY]


def magnitudes_without_preamble(cir: Cir) -> Cir:
    parts = cir.samples.reshape(-1, 2).astype(float)
    magnitude = np.hypot(*parts.T).clip(max=32000).astype(np.int16)
    return replace(cir, samples=magnitude, encoding=Encoding.MAGNITUDE, preamble_count=0)


def noise(cir: Cir) -> Cir:
    random = np.random.default_rng(len(cir.samples))
    return replace(cir, samples=random.normal(0, 60, len(cir.samples)).astype(np.int16))


def shifted(taps: int) -> Callable[[Cir], Cir]:
    return lambda cir: replace(cir, first_path_index=cir.first_path_index + taps)


def clipped(level: int) -> Callable[[Cir], Cir]:
    return lambda cir: replace(cir, samples=cir.samples.clip(-level, level))


def louder(decibels: float) -> Callable[[Cir], Cir]:
    """The same channel heard by a radio that reports, and accumulates, more (or less)."""
    gain = 10 ** (decibels / 20)
    return lambda cir: replace(
        cir,
        scale=gain,
        rx_power_dbm=cir.rx_power_dbm + decibels,
        first_path_power_dbm=cir.first_path_power_dbm + decibels,
    )


PERTURBED = {
    "magnitudes, no preamble count": magnitudes_without_preamble,
    "noise": noise,
    **{f"shifted by {taps}": shifted(taps) for taps in (-30, -10, -5, 5, 10, 30, 80)},
    **{f"clipped at {level}": clipped(level) for level in (100, 500, 2000)},
    **{
        f"{decibels} dB louder": louder(decibels) for decibels in (-25, -20, -16, -15, -10, -9, -5, 5, 10, 20)
    },
}


@pytest.mark.parametrize("name", PERTURBED)
def test_strange_measurements_are_not_made_worse(name, mitigation, records):
    perturbed = [
        replace(record, measurement=replace(record.measurement, cir=PERTURBED[name](record.measurement.cir)))
        for record in records
    ]
    outcome = evaluate(mitigation, perturbed)
    assert outcome.corrected.mae <= 1.02 * outcome.raw.mae


@pytest.mark.parametrize("decibels", [-14, -13, -12, -11])
def test_a_radio_that_is_weaker_by_a_wall_or_two_is_made_worse_by_an_eighth_at_most(
    decibels, mitigation, records
):
    # Of one range alone, a weaker radio in the open and walls that weaken as much cannot be told apart.
    weak = [
        replace(record, measurement=replace(record.measurement, cir=louder(decibels)(record.measurement.cir)))
        for record in records
    ]
    outcome = evaluate(mitigation, weak)
    # Above 1.02 too: a bundle that does better here calls for another table in docs/evaluation.md.
    assert 1.02 < outcome.corrected.mae / outcome.raw.mae <= 1.12


def test_what_cannot_be_familiar_says_so(mitigation, records):
    strange = [
        replace(record, measurement=replace(record.measurement, cir=noise(record.measurement.cir)))
        for record in records
    ]
    assert set(evaluate(mitigation, strange).statuses) == {"OUT_OF_DISTRIBUTION"}


def test_the_logs_themselves_are_familiar(mitigation, records):
    outcome = evaluate(mitigation, records)
    assert set(outcome.statuses) == {"OK"}
    assert outcome.corrected.mae < 0.4 * outcome.raw.mae


def test_the_simulated_flat_is_still_helped(mitigation):
    outcome = evaluate(mitigation, SimulatedSource(seed=1, count=600, rate_hz=40.0))
    assert outcome.corrected.mae < 0.75 * outcome.raw.mae
    assert set(outcome.statuses) == {"OK"}
