"""Compare the shipped universal models with a constant offset on a simulator that no model was trained or tuned on.

The figures are the MAE relative to that of a constant offset, for first-path indices that are 0, 5 and 10 taps late; the
LOS median is subtracted from the errors. The target of at most 1.02 is missed by `universal` in the open hall (1.08).

The training simulator draws the diffuse field from the statistics of IEEE 802.15.4a and detects the half-amplitude
point of a Gaussian pulse above a noise threshold. Here the paths are reflections of order 0 to 3 in a
three-dimensional room (Allen and Berkley, "Image method", JASA 1979) with carrier phases and Fresnel-like losses,
point scatterers, and a reverberant tail (Andersen et al., "Room electromagnetics", 2007). The antennas are dipoles with
random attitude. The receiver has a raised-cosine pulse, another gain compression and another leading-edge detector,
which also rejects paths 24 dB below the peak. The reported index is that of the edge, as of a DW1000. In LOS the median power
gap is 3.4 dB in the hall and 3.3 dB in the small room. No value was fitted to a recording or to a model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S, Encoding, RangeColumns

LIGHT_M_PER_TAP = 299_792_458.0 * SAMPLE_PERIOD_S
WAVELENGTH_M = 299_792_458.0 / 6489.6e6
"""Channel 5; the training simulator uses channel 2."""

HARDWARE_SD_M = 0.1
"""Per-pair errors that the CIR does not show: antenna delays, power-dependent bias, clock drift. With a constant
offset, 0.13 m remain in LOS in the EVK1000 logs."""

TAPS, ORIGIN, OVERSAMPLING = 512, 248, 8
NOISE_TAPS = 200
POWER_CONSTANT_DB = 121.74

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scenario:
    """Rooms of one type.

    Attributes:
        size_m: lower and upper bound of length, width and height.
        nlos: share of links with an obstacle on the direct path.
        reflection: bounds of the amplitude reflection coefficient of a room's surfaces.
        tilt: standard deviation of the attitude of the tag's antenna, rad.
        scatterers: mean number of point scatterers.
    """

    size_m: tuple[tuple[float, float, float], tuple[float, float, float]]
    nlos: float
    reflection: tuple[float, float]
    tilt: float
    scatterers: float


SCENARIOS = {
    "open hall": Scenario(((18.0, 12.0, 5.0), (45.0, 30.0, 10.0)), 0.0, (0.2, 0.7), 0.3, 12.0),
    "drone room": Scenario(((5.0, 4.0, 2.6), (10.0, 8.0, 4.5)), 0.08, (0.3, 0.8), 0.8, 10.0),
    "offices": Scenario(((4.0, 3.0, 2.4), (14.0, 9.0, 3.2)), 0.5, (0.3, 0.8), 0.2, 25.0),
}


def draw(name: str, count: int, seed: int) -> tuple[RangeColumns, Array, NDArray[np.bool_]]:
    """Return received ranges of the scenario `name`, errors (n,), m, and whether the direct path is blocked (n,).

    Frames without a detected path are omitted.
    """
    scenario, rng = SCENARIOS[name], np.random.default_rng([seed, sorted(SCENARIOS).index(name)])
    nlos = rng.random(count) < scenario.nlos
    delay_m, gain, distance = _paths(scenario, nlos, rng)
    phase = rng.random(count)
    samples, symbols, index, levels = _receive(delay_m - distance[:, None], gain, phase, rng)
    rows = np.flatnonzero(np.isfinite(index))
    error = (index + _EDGE_LEAD_TAPS - ORIGIN - phase) * LIGHT_M_PER_TAP
    error += rng.normal(0.0, HARDWARE_SD_M, count)
    zeros, ones = np.zeros(len(rows)), np.ones(len(rows))
    columns = RangeColumns(
        zeros.astype(np.uint64),
        zeros.astype(np.uint64),
        (distance + error)[rows].astype(np.float32),
        Encoding.COMPLEX_INT16,
        samples[rows],
        zeros.astype(np.int32),
        index[rows].astype(np.float32),
        ones.astype(np.float32),
        symbols[rows].astype(np.uint16),
        *(level[rows].astype(np.float32) for level in levels),
    )
    return columns, error[rows], nlos[rows]


def without_levels(columns: RangeColumns) -> RangeColumns:
    """Return the same ranges from boards that send only amplitudes."""
    parts = columns.samples.reshape(len(columns.range_m), -1, 2).astype(float)
    magnitude = np.rint(np.hypot(parts[..., 0], parts[..., 1])).clip(max=32000).astype(np.int16)
    unknown = np.full(len(magnitude), np.nan, np.float32)
    return replace(
        columns,
        encoding=Encoding.MAGNITUDE,
        samples=magnitude,
        preamble_count=np.zeros(len(magnitude), np.uint16),
        rx_power_dbm=unknown,
        first_path_power_dbm=unknown,
    )


def late(columns: RangeColumns, taps: int) -> RangeColumns:
    """Return the same ranges with a first-path index that is `taps` too high."""
    return replace(columns, first_path_index=columns.first_path_index + np.float32(taps))


def _paths(
    scenario: Scenario, nlos: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Array, NDArray[np.complex128], Array]:
    """Return path lengths (n, p), m, field gains (n, p), and true distances (n,); the direct path is first."""
    n = len(nlos)
    size = rng.uniform(*scenario.size_m, (n, 3))
    anchor = size * rng.uniform((0.02, 0.02, 0.6), (0.98, 0.98, 0.95), (n, 3))
    tag = size * rng.uniform((0.1, 0.1, 0.1), (0.9, 0.9, 0.8), (n, 3))
    steps = np.arange(-3, 4)
    order = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    order = order[np.abs(order).sum(1) <= 3]
    order = order[np.argsort(np.abs(order).sum(1), kind="stable")]
    mirrored = np.where(order % 2 == 0, tag[:, None], size[:, None] - tag[:, None])
    image = order * size[:, None] + mirrored
    surface = rng.uniform(*scenario.reflection, (n, 1, 3))
    reflected = np.prod(np.where(order > 0, -surface, surface) ** np.abs(order), axis=2)
    length = np.linalg.norm(image - anchor[:, None], axis=2)
    tilt = rng.normal(0.0, scenario.tilt, (n, 2)), rng.normal(0.0, 0.1, (n, 2))
    pattern = np.prod([_dipole(image - anchor[:, None], one) for one in tilt], axis=0)
    gain = reflected * pattern / length

    count = int(2 * scenario.scatterers)
    points = size[:, None] * rng.random((n, count, 3))
    legs = [np.linalg.norm(points - end[:, None], axis=2) for end in (anchor, tag)]
    present = rng.random((n, count)) < 0.5
    scattered = present * rng.rayleigh(0.25, (n, count)) / np.maximum(legs[0] * legs[1], 0.3)

    # The reverberant tail of all higher orders, relative to the power at 1 m: it begins where the images of order 3 end.
    tail = 120
    mean_free = 2.0 * np.prod(size, axis=1) / (size[:, :2].sum(1) * size[:, 2] + size[:, 0] * size[:, 1])
    decay_m = rng.uniform(1.0, 2.5, n) * mean_free
    excess_m = 3.0 * mean_free[:, None] + rng.uniform(0.0, 5.0, (n, tail)) * decay_m[:, None]
    power = np.exp(-excess_m / decay_m[:, None]) * 5.0 / tail * (10 ** rng.uniform(-2.2, -0.7, n))[:, None]
    reverberant = np.sqrt(power / 2.0) * rng.standard_normal((n, tail))

    # An obstacle: the direct path goes through it or around its edge; other paths are sometimes shadowed.
    loss_db = np.where(nlos, rng.uniform(6.0, 30.0, n), 0.0)
    detour_m = np.where(nlos, rng.exponential(0.2, n), 0.0)
    distance = length[:, 0].copy()
    length[:, 0] += detour_m
    gain[:, 0] *= 10 ** (-loss_db / 20)
    shadowed = nlos[:, None] & (rng.random((n, len(order) - 1)) < 0.5)
    gain[:, 1:] *= np.where(shadowed, 10 ** (-loss_db[:, None] / 40), 1.0)
    delay = np.concatenate([length, legs[0] + legs[1], distance[:, None] + excess_m], axis=1)
    field = np.concatenate([gain, scattered, reverberant], axis=1) * WAVELENGTH_M / (4.0 * np.pi)
    return delay, field * np.exp(-2j * np.pi * delay / WAVELENGTH_M), distance


def _dipole(direction: Array, tilt: Array) -> Array:
    """Return the amplitude pattern of a short dipole, tilted from the vertical by two angles (n, 2), with a floor of -15 dB."""
    axis = np.concatenate([np.sin(tilt), np.ones((len(tilt), 1))], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    cosine = np.einsum("npk,nk->np", direction, axis) / np.linalg.norm(direction, axis=2)
    return np.sqrt(np.maximum(1.0 - cosine**2, 10 ** (-15 / 10)))


def _pulse(taps: Array) -> Array:
    """Return a raised cosine with roll-off 0.9, whose width at half amplitude is 1 / 440 MHz."""
    x = taps * SAMPLE_PERIOD_S * 499.2e6
    denominator = 1.0 - (1.8 * x) ** 2
    safe = np.where(np.abs(denominator) < 1e-6, 1e-6, denominator)
    return np.sinc(x) * np.cos(0.9 * np.pi * x) / safe


def _receive(
    excess_m: Array, gain: NDArray[np.complex128], phase: Array, rng: np.random.Generator
) -> tuple[NDArray[np.int16], Array, Array, tuple[Array, Array]]:
    """Return accumulators (n, 2 TAPS), preamble counts, first-path indices and levels in dBm.

    The direct path arrives `phase` taps after `ORIGIN`.
    """
    n = len(gain)
    grid = np.arange(TAPS)
    sent_db = -14.3 + rng.uniform(-5.0, 5.0, n) + POWER_CONSTANT_DB
    symbol = np.zeros((n, TAPS), np.complex128)
    for path in range(gain.shape[1]):
        position = ORIGIN + phase + excess_m[:, path] / LIGHT_M_PER_TAP
        symbol += gain[:, path, None] * _pulse(grid - position[:, None])
    symbol *= 10 ** (sent_db / 20)[:, None]
    power_dbm = 10 * np.log10((np.abs(symbol) ** 2).sum(1)) - POWER_CONSTANT_DB
    # Above -82 dBm the gain control removes two thirds of the excess.
    symbol *= 10 ** (-np.maximum(power_dbm + 82.0, 0.0) / 30)[:, None]
    symbols = np.minimum(rng.choice([110.0, 240.0, 500.0, 1000.0], n), 14000 / np.abs(symbol).max(1)).round()
    symbols = np.maximum(symbols, 1.0)
    thermal = 10 ** ((-173.98 + rng.uniform(7.0, 12.0, n) + 60.0 + POWER_CONSTANT_DB) / 10) / 1.02
    residue = (np.abs(symbol) ** 2).sum(1) * 10 ** rng.uniform(-5.2, -4.4, n)
    noise = np.sqrt((thermal * symbols + residue * symbols**2) / 2)[:, None]
    accumulator = symbol * symbols[:, None] + noise * (
        rng.standard_normal((n, TAPS)) + 1j * rng.standard_normal((n, TAPS))
    )
    index = _leading_edge(accumulator)
    samples = np.empty((n, TAPS, 2), np.int16)
    samples[..., 0], samples[..., 1] = np.rint(accumulator.real), np.rint(accumulator.imag)
    magnitude = np.abs(accumulator)
    first = np.floor(np.where(np.isfinite(index), index, ORIGIN)).astype(int)[:, None] + np.arange(1, 4)
    energy = (magnitude**2).sum(1) - TAPS * (magnitude[:, :NOISE_TAPS] ** 2).mean(1)
    early = (np.take_along_axis(magnitude, first, 1) ** 2).sum(1)
    levels = tuple(
        10 * np.log10(np.maximum(value, 1.0) / symbols**2) - POWER_CONSTANT_DB for value in (energy, early)
    )
    return samples.reshape(n, -1), symbols, index, (levels[0], levels[1])


def _leading_edge(accumulator: NDArray[np.complex128]) -> Array:
    """Return where the interpolated magnitude crosses 0.4 of its first maximum above the threshold, or NaN."""
    spectrum = np.fft.fft(accumulator, axis=1)
    padded = np.zeros((len(accumulator), OVERSAMPLING * TAPS), np.complex128)
    padded[:, : TAPS // 2], padded[:, -TAPS // 2 :] = spectrum[:, : TAPS // 2], spectrum[:, TAPS // 2 :]
    fine = np.abs(np.fft.ifft(padded, axis=1)) * OVERSAMPLING
    quiet = fine[:, 4 * OVERSAMPLING : NOISE_TAPS * OVERSAMPLING]
    threshold = np.maximum(quiet.mean(1) + 7.0 * quiet.std(1), fine.max(1) / 16.0)
    index = np.full(len(fine), np.nan)
    for row, (values, row_threshold) in enumerate(zip(fine, threshold, strict=True)):
        above = (
            np.flatnonzero(values[NOISE_TAPS * OVERSAMPLING :] > row_threshold) + NOISE_TAPS * OVERSAMPLING
        )
        if len(above):
            top = int(above[0])
            while values[top + 1] > values[top]:
                top += 1
            low = top
            while values[low] > 0.4 * values[top]:
                low -= 1
            part = (0.4 * values[top] - values[low]) / (values[low + 1] - values[low])
            index[row] = (low + part) / OVERSAMPLING
    return index


_LEAD = np.linspace(0.0, 2.0, 4001)
_EDGE_LEAD_TAPS = float(np.interp(-0.4, -_pulse(_LEAD), _LEAD))
"""Number of taps from 0.4 of the leading edge of a single pulse to its peak."""


def relative_mae(model: Mitigation, columns: RangeColumns, error: Array, nlos: NDArray[np.bool_]) -> float:
    """Return the MAE of corrected ranges divided by that of a constant offset."""
    correction = model.correct_columns(columns).correction_m
    remaining, constant = (
        np.abs(values - np.median(values[~nlos])).mean() for values in (error - correction, error)
    )
    return float(remaining / constant)


if __name__ == "__main__":
    models = {scaling: Mitigation(load_bundle(default_model_path(scaling))) for scaling in Scaling}
    for name in SCENARIOS:
        drawn, errors, nlos = draw(name, count=1000, seed=2027)
        for scaling, mitigation in models.items():
            received = without_levels(drawn) if scaling is Scaling.MAX else drawn
            ratios = [
                relative_mae(mitigation, late(received, taps) if taps else received, errors, nlos)
                for taps in (0, 5, 10)
            ]
            print(f"{name:12} {mitigation.bundle.name:24}", *(f"{ratio:6.2f}" for ratio in ratios))
