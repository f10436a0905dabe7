"""Measurements: what they hold, and how they count samples."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from uwb_mitigation.measurement import Cir, Encoding, Origin, Status


def test_a_complex_sample_counts_once():
    assert len(Cir(np.zeros(314, np.int16))) == 157


def test_a_magnitude_counts_once():
    assert len(Cir(np.zeros(157, np.int16), Encoding.MAGNITUDE)) == 157


def test_a_cir_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Cir(np.zeros(2, np.int16)).scale = 2.0  # type: ignore[misc]


def test_the_values_are_those_of_the_messages():
    assert [status.value for status in Status] == [0, 1, 2, 3, 4]
    assert (Origin.HOST, Origin.DEVICE) == (0, 1)
    assert (Encoding.COMPLEX_INT16, Encoding.MAGNITUDE) == (0, 1)
