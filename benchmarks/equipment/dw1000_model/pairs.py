"""Radio channels of pairs of modelled chips: distance, error, accumulator; from the simulator or a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.measurement import Cir, Encoding, RangeMeasurement, Truth

SAMPLES = 1016
"""The accumulator's length at PRF 64 MHz; at 16 MHz the chip shows the first 992."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """The radio channel of a pair of chips, the same in both directions; `dw1000_pair_config` in C.

    Attributes:
        distance_m: along the straight line, 0 to 100,000.
        excess_m: excess length of the detected first path.
        samples: int16 (2 n,), real and imaginary interleaved, n at most 1016; None = one path, little noise.
        first_path_index: in samples; 0 = detected in the accumulator.
        preamble_count: RXPACC; 0 = complete preamble and SFD.
        noise_threshold, std_noise: LDE_THRESH and STD_NOISE; 0 = measured in the accumulator.
        loss, damage: probabilities that a frame is not detected, and that it is received with an error.

    Raises:
        ParameterError: a value is outside its range.
    """

    distance_m: float
    excess_m: float = 0.0
    samples: NDArray[np.int16] | None = None
    first_path_index: float = 0.0
    preamble_count: int = 0
    noise_threshold: int = 0
    std_noise: int = 0
    loss: float = 0.0
    damage: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("distance_m", 0, 100_000),
            ("excess_m", -100_000, 100_000),
            ("first_path_index", 0, SAMPLES - 1),
            ("preamble_count", 0, 4095),
            ("noise_threshold", 0, 65535),
            ("std_noise", 0, 65535),
            ("loss", 0, 1),
            ("damage", 0, 1),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ParameterError(f"{name} = {value}", where="pair", valid=f"{low} to {high}")
        if self.samples is not None:
            shape = np.shape(self.samples)
            if len(shape) != 1 or shape[0] % 2 or not 0 < shape[0] <= 2 * SAMPLES:
                raise ParameterError(
                    f"samples of shape {shape}", where="pair", valid=f"(2 n,), n from 1 to {SAMPLES}"
                )


def pair_of(
    measurement: RangeMeasurement, truth: Truth | None = None, *, loss: float = 0.0, damage: float = 0.0
) -> Pair:
    """Return a pair with which chips reproduce `measurement`.

    If the true range is known, it is the distance of the pair, and the error is its excess; otherwise the measured
    range is the distance. A CIR that is part of an accumulator is padded with zeros to its original position;
    magnitudes get the phase 0.

    Raises:
        ParameterError: the range or the CIR is missing, or the CIR is outside the accumulator.
    """
    distance_m = measurement.range_m if truth is None else truth.range_m
    return Pair(
        distance_m=distance_m,
        excess_m=measurement.range_m - distance_m,
        samples=_accumulator(measurement.cir),
        first_path_index=measurement.cir.first_path_index
        if math.isfinite(measurement.cir.first_path_index)
        else 0.0,
        preamble_count=measurement.cir.preamble_count,
        noise_threshold=measurement.cir.noise_threshold,
        loss=loss,
        damage=damage,
    )


def _accumulator(cir: Cir) -> NDArray[np.int16]:
    n, first = len(cir), cir.start_index
    if n == 0 or first < 0 or first + n > SAMPLES:
        raise ParameterError(
            f"samples {first} to {first + n - 1}", where="CIR", valid=f"some, within 0 to {SAMPLES - 1}"
        )
    if not 0 < cir.scale < math.inf:
        raise ParameterError(f"scale = {cir.scale}", where="CIR", valid="above 0, finite")
    counts = np.clip(np.rint(cir.samples * np.float64(cir.scale)), -32768, 32767).astype(np.int16)
    accumulator = np.zeros(2 * SAMPLES, np.int16)
    step = 1 if cir.encoding is Encoding.COMPLEX_INT16 else 2
    accumulator[2 * first : 2 * (first + n) : step] = counts
    return accumulator
