"""DW1000-like receiver: accumulator, first path and diagnostics from multipath.

PRF 64 MHz. The range error is not drawn from a distribution: it is the difference between the first path of
the leading-edge detector and the straight-line path. docs/background/how_it_works.md describes the parameters that
were fitted to the EVK1000 logs, and the quality of the fit. `DW3000_STS` is a variant with assumed parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.simulation.channel import CHANNEL_2, SPEED_OF_LIGHT_M_PER_NS, Channel, Multipath
from uwb_mitigation.types.columns import Columns
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S, RadioType, Segment

TAPS = 1016
"""Accumulator length: one preamble symbol at PRF 64 MHz (DW1000 user manual, section 7.2.38)."""

POWER_CONSTANT_DB = 121.74
"""The constant A of the manual's power estimates at PRF 64 MHz (section 4.7)."""

TAP_NS = SAMPLE_PERIOD_S * 1e9
SYMBOL_S = TAPS * SAMPLE_PERIOD_S
BOLTZMANN_290K_DBM_HZ = -173.98
INDEX_STEPS = 64
"""The detector reports the first path in 1/64 of a tap (FP_INDEX, section 7.2.22)."""

PLACE = (739.0, 751.0)
"""Accumulator indices of the straight-line path: the middle 90 % of the logs' first paths."""
RAYLEIGH_VARIANCE = 1.0 - math.pi / 4.0
"""Variance of the magnitude of complex noise of unit power."""

NOISE_TAPS = slice(64, 576)
FIRST_SEARCHED_TAP = 640
"""The noise is measured well before the earliest first path; the search begins after this region."""

PULSE_SPACING_TAPS = 16
"""Spacing of the pulses of an STS: one in 8 chips (IEEE 802.15.4z, BPRF)."""

SIDE_LOBE_SIGMAS = 5.0
"""Minimum of the detection threshold in standard deviations of the side lobes of the strongest tap. An assumption: with
a threshold that only follows the noise, 0.3 % of simulated LOS frames are detected at a side lobe."""

_SPAN = 8
_PHASES = 64
_EDGE_STEPS = 32
_EDGE_TAPS = (-3, 5)
_KERNEL_REACH = 10


def pulse(taps: NDArray[np.float64], channel: Channel = CHANNEL_2) -> NDArray[np.float64]:
    """Return the accumulator's response to a single path, at `taps` from its peak; unit energy over the taps.

    A Gaussian with the width of the first path in the LOS EVK1000 logs, whose edges it matches. The raised cosine of
    the standard's reference pulse would have sidelobes of 12 %, which the logs do not contain and which the detector
    would detect as paths.
    """
    x = np.asarray(taps, np.float64) / channel.pulse_taps
    shape: NDArray[np.float64] = np.exp(-4.0 * math.log(2.0) * x * x)
    return shape / math.sqrt(channel.pulse_taps * math.sqrt(math.pi / (8.0 * math.log(2.0))))


_OFFSETS = np.arange(1 - _SPAN, _SPAN + 1)
_FINE_TAPS = np.arange(_EDGE_TAPS[0], _EDGE_TAPS[1], 1.0 / _EDGE_STEPS)
_EDGE_WINDOW = np.arange(_EDGE_TAPS[0] - _KERNEL_REACH, _EDGE_TAPS[1] + _KERNEL_REACH)
_OFFSET_FROM_TAP = _EDGE_WINDOW[:, None] - _FINE_TAPS[None, :]
# At half the tap rate the pulse's spectrum is down to 1 %, so a tapered sinc interpolates it well.
_INTERPOLATE = (
    np.sinc(_OFFSET_FROM_TAP)
    * np.where(
        np.abs(_OFFSET_FROM_TAP) < _KERNEL_REACH,
        np.cos(math.pi * _OFFSET_FROM_TAP / (2 * _KERNEL_REACH)),
        0.0,
    )
).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Reception:
    """Results of n receptions.

    Levels, index and error are NaN if the frame was not received: below the sensitivity, or no path above the
    threshold.

    Attributes:
        samples: int16 (n, 2 TAPS), interleaved real, imaginary.
        first_path_index: float64 (n,), accumulator index, the half-amplitude point of the edge.
        preamble_count, noise_threshold: int64 (n,), RXPACC and LDE_THRESH.
        rx_power_dbm, first_path_power_dbm: float64 (n,), by the manual's formulas.
        direct_above_threshold: bool (n,), whether the direct path alone would have been detected.
        error_m: float64 (n,), detected minus straight-line path length, plus the radio's offset.
    """

    samples: NDArray[np.int16]
    first_path_index: NDArray[np.float64]
    preamble_count: NDArray[np.int64]
    noise_threshold: NDArray[np.int64]
    rx_power_dbm: NDArray[np.float64]
    first_path_power_dbm: NDArray[np.float64]
    direct_above_threshold: NDArray[np.bool_]
    error_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Boards(Columns):
    """Board properties of n pairs (both ends) that differ between boards with the same chip: float64 (n,) each.

    Attributes:
        gain_db: transmit power and both antennas, relative to the `Receiver`.
        noise_figure_db, preamble_symbols, self_noise_db, noise_multiplier: replace those of the `Receiver`.
    """

    gain_db: NDArray[np.float64]
    noise_figure_db: NDArray[np.float64]
    preamble_symbols: NDArray[np.float64]
    self_noise_db: NDArray[np.float64]
    noise_multiplier: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Receiver:
    """A receiver and its transmitter.

    Attributes:
        tx_power_dbm: -41.3 dBm/MHz over 500 MHz; regulations allow more on the wider channels (`sent_dbm`).
        noise_figure_db: receiver noise and implementation loss together; gives the logs' tap noise.
        compression_dbm: level towards which the receiver's gain control compresses strong signals
            (see the manual's section 4.7.1).
        self_noise_db: residue of the preamble's correlation in each tap, relative to the total power.
        sensitivity_dbm: frames below this are lost; the DW1000 at 850 kbit/s (datasheet, section 5.3).
        preamble_symbols: maximum number of accumulated symbols (1024 are sent, the first ones are used for detection).
        accumulator_limit: accumulation stops when a component reaches this.
        noise_multiplier: NTM of LDE_CFG1, the factor from the noise's standard deviation to the threshold.
        range_offset_m: mean error of uncalibrated antenna delays, from the logs.
        timestamp_std_m: standard deviation of ranges without changes of the channel.
        symbol_counts: numbers of accumulated symbols of different boards; a preamble less 24 symbols for its detection
            (the logs: 1000 of 1024 are accumulated).
        pulses_per_symbol: pulses of a pseudo-random sequence, whose correlation has side lobes at multiples of
            `PULSE_SPACING_TAPS`; 0: a preamble, whose periodic correlation is perfect.
        kind, segment: source of the CIRs.
        channel: UWB channel.
    """

    tx_power_dbm: float = -14.3
    noise_figure_db: float = 9.8
    compression_dbm: float = -78.0
    self_noise_db: float = -47.0
    sensitivity_dbm: float = -101.0
    preamble_symbols: int = 1000
    accumulator_limit: float = 16384.0
    noise_multiplier: float = 13.0
    range_offset_m: float = 0.22
    timestamp_std_m: float = 0.02
    symbol_counts: tuple[int, ...] = (104, 232, 488, 1000)
    pulses_per_symbol: int = 0
    kind: RadioType = RadioType.DW1000
    segment: Segment = Segment.IPATOV
    channel: Channel = CHANNEL_2

    @property
    def sent_dbm(self) -> float:
        """Transmit power on the channel: the limit is that of the power per MHz."""
        return self.tx_power_dbm + 10.0 * math.log10(self.channel.bandwidth_hz / CHANNEL_2.bandwidth_hz)

    @property
    def pulse_peak(self) -> float:
        """Peak of `pulse`."""
        return float(pulse(np.zeros(1), self.channel)[0])

    def boards(self, n: int) -> Boards:
        """Return the properties of n pairs between identical boards."""
        values = (self.noise_figure_db, self.preamble_symbols, self.self_noise_db, self.noise_multiplier)
        return Boards(np.zeros(n), *(np.full(n, float(value)) for value in values))

    def noise_level_dbm(self, noise_figure_db: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the thermal noise of one tap over one symbol, on the scale of the paths' powers.

        A matched filter's peak has a signal-to-noise ratio of P T / (k T0 F); the peak tap of a single path
        contains pulse(0)^2 of its power.
        """
        per_symbol = BOLTZMANN_290K_DBM_HZ - 10.0 * math.log10(SYMBOL_S) + 20.0 * math.log10(self.pulse_peak)
        return per_symbol + noise_figure_db

    def sensitivities_dbm(self, boards: Boards) -> NDArray[np.float64]:
        """Return the sensitivity of each link; a longer preamble and less noise improve it."""
        longer = 10.0 * np.log10(boards.preamble_symbols / self.preamble_symbols)
        return self.sensitivity_dbm - longer + (boards.noise_figure_db - self.noise_figure_db)

    def compression(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the amplitude gain of frames with the given power (sum of squares for each symbol squared)."""
        limit = 10.0 ** ((self.compression_dbm + POWER_CONSTANT_DB) / 20.0)
        return np.asarray((1.0 + (np.sqrt(power) / limit) ** 1.5) ** (-1.0 / 1.5), np.float64)

    def direct_margin_db(
        self, direct_db: NDArray[np.float64], diffuse_db: NDArray[np.float64], boards: Boards
    ) -> NDArray[np.float64]:
        """Predict the level of the direct path above the threshold, without running `receive`.

        Args:
            direct_db: power of the direct path relative to the transmit power, float64 (n,).
            diffuse_db: power of all other paths relative to the transmit power, float64 (n,).
            boards: properties of the boards.

        Returns:
            Level above the threshold in dB, float64 (n,).
        """
        sent = self.sent_dbm + boards.gain_db + POWER_CONSTANT_DB
        direct, diffuse = (10.0 ** ((sent + power) / 10.0) for power in (direct_db, diffuse_db))
        power = direct + diffuse
        # The strongest of the other paths has about a tenth of their power.
        strongest = np.maximum(direct, 0.1 * diffuse)
        peak = self.pulse_peak * np.sqrt(strongest) * self.compression(power)
        count = np.minimum(self.accumulator_limit / np.maximum(peak, 1e-9), boards.preamble_symbols)
        thermal = 10.0 ** ((self.noise_level_dbm(boards.noise_figure_db) + POWER_CONSTANT_DB) / 10.0)
        noise = thermal / np.maximum(count, 1.0) + power * 10.0 ** (boards.self_noise_db / 10.0)
        threshold = boards.noise_multiplier**2 * RAYLEIGH_VARIANCE * noise
        if self.pulses_per_symbol:
            side_lobes = self.pulse_peak**2 * strongest / (self.pulses_per_symbol * np.maximum(count, 1.0))
            threshold = np.maximum(threshold, SIDE_LOBE_SIGMAS**2 * side_lobes)
        return 10.0 * np.log10(self.pulse_peak**2 * direct / threshold)

    def receive(
        self, multipath: Multipath, rng: np.random.Generator, boards: Boards | None = None
    ) -> Reception:
        """Receive n frames over n pairs, each with its own sampling phase and noise.

        Amplitudes are scaled so that the sum of squares over the taps, divided by the square of the
        preamble count, is the received power by the manual's formula.
        """
        boards = boards or self.boards(len(multipath.delay_ns))
        place = rng.uniform(*PLACE, len(multipath.delay_ns))
        symbol = place_paths(place[:, None] + multipath.delay_ns / TAP_NS, multipath.gain, self.channel)
        scale = 10.0 ** ((self.sent_dbm + boards.gain_db + POWER_CONSTANT_DB) / 20.0)
        symbol *= scale.astype(np.float32)[:, None]

        components = symbol.view(np.float32)
        power = np.einsum("ij,ij->i", components, components).astype(np.float64)
        above_sensitivity = power >= 10.0 ** ((self.sensitivities_dbm(boards) + POWER_CONSTANT_DB) / 10.0)
        gain = self.compression(power)
        power *= gain * gain
        symbol *= gain[:, None].astype(np.float32)

        peak = np.maximum(components.max(axis=1), -components.min(axis=1)).astype(np.float64)
        # A strong signal fills the accumulator in fewer symbols, but in at least one.
        max_count = np.minimum(self.accumulator_limit / np.maximum(peak, 1e-9), boards.preamble_symbols)
        count = np.maximum(max_count, 1.0).astype(np.int64)

        thermal = 10.0 ** ((self.noise_level_dbm(boards.noise_figure_db) + POWER_CONSTANT_DB) / 10.0)
        if self.pulses_per_symbol:
            symbol += _side_lobes(symbol, self.pulses_per_symbol * count, rng)
        # Over the symbols, thermal noise adds up in power, the residue of the preamble in amplitude.
        noise = thermal * count * gain * gain + power * count**2.0 * 10.0 ** (boards.self_noise_db / 10.0)
        accumulator = rng.standard_normal(components.shape, dtype=np.float32)
        accumulator *= np.sqrt(noise / 2.0).astype(np.float32)[:, None]
        accumulator += components * count.astype(np.float32)[:, None]
        samples = np.clip(np.rint(accumulator), -32768, 32767).astype(np.int16)
        direct = np.abs(multipath.gain[:, 0]) * scale * gain * count * self.pulse_peak
        return self.report(samples, count, direct, place, above_sensitivity, boards, rng)

    def report(
        self,
        samples: NDArray[np.int16],
        count: NDArray[np.int64],
        direct: NDArray[np.float64],
        place: NDArray[np.float64],
        above_sensitivity: NDArray[np.bool_],
        boards: Boards,
        rng: np.random.Generator,
    ) -> Reception:
        """Return first path, levels and error of accumulators (n, 2 TAPS) with straight-line paths at `place`."""
        quantised = samples.astype(np.float32)
        taps = quantised.view(np.complex64)
        magnitude = np.abs(taps)
        threshold = noise_threshold(magnitude, boards.noise_multiplier)
        if self.pulses_per_symbol:
            side_lobe = magnitude.max(axis=1) / np.sqrt(self.pulses_per_symbol * count)
            threshold = np.maximum(threshold, np.rint(SIDE_LOBE_SIGMAS * side_lobe).astype(np.int64))
        index = np.where(above_sensitivity, detect_first_path(taps, magnitude, threshold), np.nan)
        rx_power, first_path_power = power_levels(magnitude, index, count)
        error = (index + self.channel.pulse_taps / 2.0 - place) * TAP_NS * SPEED_OF_LIGHT_M_PER_NS
        error += self.range_offset_m + rng.normal(0.0, self.timestamp_std_m, len(error))
        return Reception(
            samples, index, count, threshold, rx_power, first_path_power, direct >= threshold, error
        )


DW3000_STS = Receiver(
    tx_power_dbm=-19.3,
    self_noise_db=-60.0,
    sensitivity_dbm=-94.0,
    preamble_symbols=64,
    range_offset_m=0.0,
    symbol_counts=(32, 64, 128),
    pulses_per_symbol=64,
    kind=RadioType.DW3000,
    segment=Segment.STS,
)
"""STS of a DW3000 on channel 5. Assumed: channel 2 with 5 dB more path loss, and pulse, noise figure, compression and first-path
detector of the DW1000. No real recording was available (models/dw3000_sts.md)."""


def _side_lobes(
    symbol: NDArray[np.complex64], pulses: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.complex64]:
    """Return the side lobes of the correlation of random sequences of `pulses` (n,) with a channel (n, TAPS)."""
    lobes = np.arange(PULSE_SPACING_TAPS, TAPS // 2, PULSE_SPACING_TAPS)
    kernel = np.zeros(symbol.shape, np.float32)
    # Each lobe is the mean of products of random signs; an autocorrelation is symmetric.
    kernel[:, lobes] = rng.standard_normal((len(symbol), len(lobes))) / np.sqrt(pulses)[:, None]
    kernel[:, -lobes] = kernel[:, lobes]
    return np.fft.ifft(np.fft.fft(symbol) * np.fft.fft(kernel)).astype(np.complex64)


@cache
def _pulse_table(channel: Channel) -> NDArray[np.float64]:
    """Return pulses at all phases of a tap, float64 (_PHASES, 2 _SPAN)."""
    return pulse(_OFFSETS[None, :] - np.arange(_PHASES)[:, None] / _PHASES, channel)


def place_paths(
    position: NDArray[np.float64], gain: NDArray[np.complex128], channel: Channel
) -> NDArray[np.complex64]:
    """Sum pulses at fractional tap positions (n, paths) into complex64 (n, TAPS)."""
    n = len(position)
    step = np.rint(position * _PHASES).astype(np.int64)
    tap, phase = step // _PHASES, step % _PHASES
    row, path = np.nonzero((tap < TAPS - _SPAN) & (gain != 0))
    where = ((row * TAPS + tap[row, path])[:, None] + _OFFSETS).ravel()
    shape = _pulse_table(channel)[phase[row, path]]
    value = gain[row, path]
    result = np.empty((n, TAPS), np.complex64)
    for component, weight in ((result.real, value.real), (result.imag, value.imag)):
        component[:] = np.bincount(where, (shape * weight[:, None]).ravel(), n * TAPS).reshape(n, TAPS)
    return result


def noise_threshold(magnitude: NDArray[np.float32], multiplier: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return LDE_THRESH of (n, TAPS) magnitudes: the noise's standard deviation times NTM, at least 1."""
    deviation = magnitude[:, NOISE_TAPS].std(axis=1)
    return np.asarray(np.clip(np.rint(multiplier * deviation), 1, 65535), np.int64)


def detect_first_path(
    taps: NDArray[np.complex64], magnitude: NDArray[np.float32], threshold: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the first-path index of (n, TAPS) accumulators, float64 (n,); NaN if no path is found.

    The edge starts at the first tap above the threshold. The index is where the interpolated magnitude reaches half of the
    edge's first maximum, so that it hardly depends on the strength of the path and on later paths.
    """
    above = magnitude[:, FIRST_SEARCHED_TAP:] > threshold[:, None]
    is_found = above.any(axis=1)
    crossing = above.argmax(axis=1) + FIRST_SEARCHED_TAP
    crossing = np.minimum(crossing, TAPS - 1 - int(_EDGE_WINDOW[-1]))
    rows = np.arange(len(taps))
    window = taps[rows[:, None], crossing[:, None] + _EDGE_WINDOW]
    fine = np.hypot(window.real @ _INTERPOLATE, window.imag @ _INTERPOLATE)

    # The edge may cross the threshold between the previous tap and the first one above it.
    rising = fine[:, 1:-1]
    peaked = (rising >= threshold[:, None]) & (rising >= fine[:, 2:])
    peaked[:, : (-1 - _EDGE_TAPS[0]) * _EDGE_STEPS] = False
    peaked[:, -1] = True
    top = peaked.argmax(axis=1) + 1
    half = fine[rows, top] / 2.0
    below = (fine <= half[:, None]) & (np.arange(fine.shape[1]) < top[:, None])
    last = np.where(below.any(axis=1), fine.shape[1] - 1 - below[:, ::-1].argmax(axis=1), 0)
    low, high = fine[rows, last], fine[rows, last + 1]
    rise = np.where(high > low, high - low, 1.0)
    fraction = np.clip((half - low) / rise, 0.0, 1.0)
    index = crossing + _FINE_TAPS[last] + fraction / _EDGE_STEPS
    index = np.rint(index * INDEX_STEPS) / INDEX_STEPS
    return np.where(is_found, index, np.nan)


def power_levels(
    magnitude: NDArray[np.float32], index: NDArray[np.float64], count: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return receive and first-path level, dBm (DW1000 user manual, section 4.7), NaN where index is NaN.

    RSL = 10 log10(C 2^17 / N^2) - A and FSL = 10 log10((F1^2 + F2^2 + F3^2) / N^2) - A, with C the
    power over all taps minus the noise power, in units of 2^17, F1 to F3 the magnitudes one to three
    taps after the index, and N the preamble count.
    """
    energy = np.einsum("ij,ij->i", magnitude, magnitude, dtype=np.float64)
    noise_taps = magnitude[:, NOISE_TAPS].astype(np.float64)
    noise = np.einsum("ij,ij->i", noise_taps, noise_taps) / noise_taps.shape[1] * magnitude.shape[1]
    cir_power = np.maximum(np.rint((energy - noise) / 2.0**17), 1.0)
    is_found = np.isfinite(index)
    first = np.floor(np.where(is_found, index, 0.0)).astype(np.int64)
    window = np.rint(magnitude[np.arange(len(index))[:, None], first[:, None] + np.arange(1, 4)])
    first_power = np.maximum((window.astype(np.float64) ** 2).sum(axis=1), 1.0)
    squared = count.astype(np.float64) ** 2
    receive = 10.0 * np.log10(cir_power * 2.0**17 / squared) - POWER_CONSTANT_DB
    first_path = 10.0 * np.log10(first_power / squared) - POWER_CONSTANT_DB
    return np.where(is_found, receive, np.nan), np.where(is_found, first_path, np.nan)
