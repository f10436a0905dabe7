"""Preprocessing: window and bit-exact scaling. `test_mitigation` has the faults."""

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


@pytest.mark.parametrize("scaling", list(Scaling))
@pytest.mark.parametrize("encoding", list(Encoding))
@settings(max_examples=25)
@given(data=st.data())
def test_inputs_equal_the_specification_bit_by_bit(scaling, encoding, data):
    generator = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
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


def test_saturated_sample_outside_the_window_is_accepted():
    samples = cir().samples.copy()
    samples[0] = 32767
    assert apply(cir(samples=samples))[0] == 0


@pytest.mark.parametrize(("samples", "is_valid"), [(0, False), (1, True), (1016, True), (1017, False)])
def test_window_has_1_to_1016_samples(samples, is_valid):
    with contextlib.nullcontext() if is_valid else pytest.raises(UwbMitigationError):
        Preprocessing(samples)
