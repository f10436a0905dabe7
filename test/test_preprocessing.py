"""Preprocessing: window, bit-exact scaling, and every fault."""

from __future__ import annotations

import contextlib
import math
import struct
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_material import cir, window_of

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.types.measurement import Cir, CirFault, Encoding


def single(value: float) -> float:
    """Round to float32. A float64 product, quotient or root rounds to float32 as if computed exactly."""
    return float(struct.unpack("f", struct.pack("f", value))[0])


def reference(cir: Cir, samples: int, scaling: Scaling) -> list[float]:
    """The specification in plain Python: each operation is rounded to float32."""
    start = math.floor(cir.first_path_index) - 5 - cir.start_index
    values = []
    for index in range(start, start + samples):
        if cir.encoding == Encoding.COMPLEX_INT16:
            re, im = int(cir.samples[2 * index]), int(cir.samples[2 * index + 1])
            magnitude = single(math.sqrt(single(re * re + im * im)))
        else:
            magnitude = float(cir.samples[index])
        values.append(single(magnitude * single(cir.scale)))
    if scaling is Scaling.MAX:
        return [single(value / max(values)) for value in values]
    return [single(math.sqrt(single(value / (60 * cir.preamble_count)))) for value in values]


def apply(cir: Cir, samples: int = 157, scaling: Scaling = Scaling.PREAMBLE):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return window_of(cir, Preprocessing(samples, scaling))


def fault(cir: Cir, samples: int = 157, scaling: Scaling = Scaling.PREAMBLE):
    return apply(cir, samples, scaling)[0]


@pytest.mark.parametrize("scaling", list(Scaling))
@pytest.mark.parametrize("encoding", list(Encoding))
@settings(max_examples=25)
@given(data=st.data())
def test_inputs_equal_the_specification_bit_by_bit(scaling, encoding, data):
    seed = data.draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    low = -32766 if encoding == Encoding.COMPLEX_INT16 else 0
    samples = generator.integers(low, 32767, 128).astype(np.int16)
    start_index = data.draw(st.integers(-2000, 2000))
    first_path = start_index + data.draw(st.floats(5, 61.99))
    subject = Cir(
        samples,
        encoding,
        start_index,
        first_path,
        scale=data.draw(st.sampled_from([1.0, 0.37, 1e-3, 16.5])),
        preamble_count=data.draw(st.integers(1, 65535)),
    )
    found, out = apply(subject, 8, scaling)
    if found == CirFault.TOO_SHORT:
        assert math.floor(first_path) - subject.start_index + 3 > len(subject)
    else:
        assert found == 0
        assert out.tolist() == reference(subject, 8, scaling)


IN_DB = np.rint(20 * np.log10(np.random.default_rng(1).rayleigh(20.0, 1016) + 1)).astype(np.int16)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"samples": np.zeros(0, np.int16)}, CirFault.EMPTY),
        ({"samples": np.ones(2033, np.int16)}, CirFault.ODD_LENGTH),
        ({"scale": 0.0}, CirFault.BAD_SCALE),
        ({"scale": math.nan}, CirFault.BAD_SCALE),
        ({"scale": 1e38}, CirFault.BAD_SCALE),
        ({"first_path_index": math.nan}, CirFault.NO_FIRST_PATH),
        ({"first_path_index": -math.inf}, CirFault.NO_FIRST_PATH),
        ({"first_path_index": 4.99}, CirFault.TOO_SHORT),
        ({"first_path_index": 865.0}, CirFault.TOO_SHORT),
        ({"first_path_index": 1016.0}, CirFault.OUTSIDE),
        ({"first_path_index": 1e300}, CirFault.OUTSIDE),
        ({"start_index": 2**31 - 1}, CirFault.OUTSIDE),
        ({"samples": np.zeros(2032, np.int16)}, CirFault.ALL_ZERO),
        ({"samples": np.full(2032, -32768, np.int16)}, CirFault.SATURATED),
        ({"samples": np.full(2032, 32767, np.int16)}, CirFault.SATURATED),
        ({"samples": np.full(1016, 32767, np.int16), "encoding": Encoding.MAGNITUDE}, CirFault.SATURATED),
        ({"samples": np.int16(-np.eye(1, 1016, 750)[0]), "encoding": Encoding.MAGNITUDE}, CirFault.NEGATIVE),
        ({"samples": IN_DB, "encoding": Encoding.MAGNITUDE}, CirFault.DECIBELS),
        ({"preamble_count": 0}, CirFault.NO_PREAMBLE_COUNT),
    ],
)
def test_each_fault_is_detected(changes, expected):
    assert fault(cir(**changes)) == expected


def test_saturated_sample_outside_the_window_is_accepted():
    samples = cir().samples.copy()
    samples[0] = 32767
    assert fault(cir(samples=samples)) == 0


@pytest.mark.parametrize(("samples", "is_valid"), [(0, False), (1, True), (1016, True), (1017, False)])
def test_window_has_1_to_1016_samples(samples, is_valid):
    with contextlib.nullcontext() if is_valid else pytest.raises(UwbMitigationError):
        Preprocessing(samples)
