"""Multipath propagation: the direct path, followed by a diffuse field of clusters and rays.

The direct path is deterministic (free-space and obstacle loss); the diffuse field follows the IEEE 802.15.4a
channel model. The receiver model is in `simulation.radio`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.types.columns import Columns

SPEED_OF_LIGHT_M_PER_NS = 0.299792458


@dataclass(frozen=True, slots=True)
class Channel:
    """A UWB channel of a DW1000.

    Attributes:
        number: of the channel. centre_hz: centre frequency. bandwidth_hz: of the receiver, for paths.
        pulse_taps: full width at half amplitude of a single path in the accumulator.
    """

    number: int
    centre_hz: float
    bandwidth_hz: float = 499.2e6
    pulse_taps: float = 2.4

    @property
    def wavelength_m(self) -> float:
        """Wavelength at the centre frequency, m."""
        return SPEED_OF_LIGHT_M_PER_NS * 1e9 / self.centre_hz

    @property
    def free_space_loss_1m_db(self) -> float:
        """Free-space loss at 1 m, dB (Friis, isotropic antennas)."""
        return 20.0 * math.log10(4.0 * math.pi / self.wavelength_m)


CHANNELS = {
    channel.number: channel
    for channel in (
        Channel(1, 3494.4e6),
        Channel(2, 3993.6e6),
        Channel(3, 4492.8e6),
        Channel(4, 3993.6e6, 900e6, 1.8),
        Channel(5, 6489.6e6),
        Channel(7, 6489.6e6, 900e6, 1.8),
    )
}
"""IEEE 802.15.4-2015, UWB PHY; a DW1000 receives at most 900 MHz (user manual, section 10.5). The pulse of the LOS EVK1000 logs
(channel 2) is about the inverse of the bandwidth. The inverse of 900 MHz would be 1.33 taps: 1.8 is the shortest pulse that samples resolve."""

CHANNEL_2 = CHANNELS[2]

PATTERN_LOSS_DB = (4.0, 1.0)
"""Shape and scale of the gamma-distributed loss that two small antennas' patterns add to the direct
path. The direct path has one direction, the diffuse field has all, so only their ratio matters. The mean of
4 dB is the mean difference of receive and first-path level in the LOS EVK1000 logs."""

MAX_DECAY_NS = 200.0
"""Upper limit of decay times: 200 of the 1016 taps of a CIR."""

MAX_CLUSTERS = 10
RAYS_PER_CLUSTER = 28
"""The omitted rays contain less than 0.1 % of the mean power of a residential cluster."""


@dataclass(frozen=True, slots=True)
class Environment:
    """Statistics of the diffuse field and of path loss, in the notation of the 802.15.4a report.

    Attributes:
        name: display name.
        path_loss_1m_db: PL0. path_loss_exponent: n. shadowing_db: sigma_S.
        frequency_exponent: kappa, of the path loss.
        mean_clusters: L. cluster_rate_per_ns: Lambda.
        ray_rates_per_ns: lambda_1, lambda_2. ray_mix: beta, the probability of lambda_1.
        cluster_decay_ns: Gamma. ray_decay_ns: gamma_0. cluster_shadowing_db: sigma_cluster.
        nakagami_log_mean, nakagami_log_std: m is log-normal, exp of a normal with these.
        first_cluster_delay_ns: mean (exponential) delay of the first cluster relative to the straight line.
        ray_decay_growth: k_gamma, increase of the ray decay time per ns of cluster delay.
    """

    name: str
    path_loss_1m_db: float
    path_loss_exponent: float
    shadowing_db: float
    frequency_exponent: float
    mean_clusters: float
    cluster_rate_per_ns: float
    ray_rates_per_ns: tuple[float, float]
    ray_mix: float
    cluster_decay_ns: float
    ray_decay_ns: float
    cluster_shadowing_db: float
    nakagami_log_mean: float
    nakagami_log_std: float
    first_cluster_delay_ns: float
    ray_decay_growth: float = 0.0

    def path_loss_db(self, distance_m: NDArray[np.float64], channel: Channel) -> NDArray[np.float64]:
        """Return the mean path loss in dB (section II-A of the report).

        It is a power law in distance and in frequency, with a factor of 1/2 for objects close to an antenna.
        """
        frequency = 20.0 * (self.frequency_exponent + 1.0) * math.log10(channel.centre_hz / 5e9)
        at_1m = self.path_loss_1m_db + frequency + 10.0 * math.log10(2.0)
        return at_1m + 10.0 * self.path_loss_exponent * np.log10(distance_m)


# Each row: name, PL0, n, sigma_S, kappa, L, Lambda, (lambda_1, lambda_2), beta, Gamma, gamma_0, sigma_cluster, mean and standard
# deviation of ln m, delay of the first cluster, k_gamma.
#
# Molisch et al., "IEEE 802.15.4a channel model - final report", 2004, residential environments (CM1, CM2);
# except for the last value of each. For LOS the diffuse field starts with the direct path. For NLOS its mean delay
# is the mean range error of the EVK1000 logs without a direct path minus that of LOS (0.8 m; the report's
# program uses 1 / Lambda = 8.3 ns).
RESIDENTIAL_LOS = Environment("residential LOS", 43.9, 1.79, 2.22, 1.12, 3.0, 0.047, (1.54, 0.15), 0.095, 22.61, 12.53, 2.75, 0.67, 0.28, 0.0)  # fmt: skip
RESIDENTIAL_NLOS = Environment("residential NLOS", 48.7, 4.58, 3.51, 1.53, 3.5, 0.12, (1.77, 0.15), 0.045, 26.27, 17.5, 2.93, 0.69, 0.32, 2.7)  # fmt: skip

# The same report's office (CM3, CM4; clusters of CM4 as in its program) and industrial environments (CM7,
# CM8). It gives no ray rates for industry, where every nanosecond had a path, and one long cluster for CM8. Here CM8 uses
# the clusters of CM7 with its own path loss. Behind obstacles the first cluster has the residential delay.
OFFICE_LOS = Environment("office LOS", 35.4, 1.63, 1.9, 0.03, 5.4, 0.016, (0.19, 2.97), 0.0184, 14.6, 6.4, 3.0, 0.42, 0.31, 0.0)  # fmt: skip
OFFICE_NLOS = Environment("office NLOS", 59.9, 3.07, 3.9, 0.71, 3.1, 0.19, (0.11, 2.09), 0.0096, 19.8, 11.2, 3.0, 0.5, 0.25, 2.7)  # fmt: skip
INDUSTRIAL_LOS = Environment("industrial LOS", 56.7, 1.2, 6.0, -1.103, 4.75, 0.0709, (1.0, 1.0), 0.0, 13.47, 0.651, 4.32, 0.36, 1.13, 0.0, 0.926)  # fmt: skip
INDUSTRIAL_NLOS = Environment("industrial NLOS", 56.7, 2.15, 6.0, -1.427, 4.75, 0.0709, (1.0, 1.0), 0.0, 13.47, 0.651, 4.32, 0.3, 1.15, 2.7, 0.926)  # fmt: skip


# The same report's outdoor environment (CM5), with fewer clusters than 13.6 because of `MAX_CLUSTERS`.
OUTDOOR_LOS = Environment("outdoor LOS", 45.6, 1.76, 0.83, 0.12, 6.0, 0.0048, (0.27, 2.41), 0.0078, 31.7, 3.7, 3.0, 0.77, 0.78, 0.0)  # fmt: skip


@dataclass(frozen=True, slots=True)
class DiffuseField(Columns):
    """Delays and mean powers of the rays of n placements; they change over metres.

    Attributes:
        delay_ns: float64 (n, rays), relative to the straight line.
        mean_power: float64 (n, rays), sums to 1 over the rays.
        nakagami_m: float64 (n, rays), fading parameter, at least 0.5.
        shadowing_db: float64 (n,), of the total power.
        pattern_loss_db: float64 (n,), loss of the direct path (`PATTERN_LOSS_DB`).
    """

    delay_ns: NDArray[np.float64]
    mean_power: NDArray[np.float64]
    nakagami_m: NDArray[np.float64]
    shadowing_db: NDArray[np.float64]
    pattern_loss_db: NDArray[np.float64]

    def moved(
        self, end: DiffuseField, progress: NDArray[np.float64], changes_at: NDArray[np.float64]
    ) -> DiffuseField:
        """Return fields on the way to `end`, with the same distributions; of the pattern loss, only mean and variance.

        The rays of `end` replace those of this field one by one. All other properties change continuously. On the way, up to
        0.25 % of the pattern losses are negative (a gain).

        Args:
            end: fields at the end of the way.
            progress: share of the way, 0 to 1, float64 (n,).
            changes_at: share of the way at which each ray is replaced, float64 (n, rays).
        """
        is_replaced = progress[:, None] > changes_at
        remaining, passed = np.maximum(1.0 - progress, 1e-9), np.maximum(progress, 1e-9)
        # The first ray of the first cluster is at its start. The minimum of exponential variables is exponential.
        first, end_first = self.delay_ns[:, :1], end.delay_ns[:, :1]
        first_delay = np.minimum(first / remaining[:, None], end_first / passed[:, None])
        delay = first_delay + np.where(is_replaced, end.delay_ns - end_first, self.delay_ns - first)
        power = np.where(is_replaced, end.mean_power, self.mean_power)
        mean_loss = math.prod(PATTERN_LOSS_DB)
        # The sum of squares of both weights is 1, so that variances stay the same.
        weight, end_weight = np.sqrt(remaining), np.sqrt(passed)
        return DiffuseField(
            delay,
            power / power.sum(axis=1, keepdims=True),
            np.where(is_replaced, end.nakagami_m, self.nakagami_m),
            weight * self.shadowing_db + end_weight * end.shadowing_db,
            mean_loss
            + weight * (self.pattern_loss_db - mean_loss)
            + end_weight * (end.pattern_loss_db - mean_loss),
        )

    def fade(self, rng: np.random.Generator) -> NDArray[np.complex128]:
        """Draw the rays' gains, complex128 (n, rays): Nakagami magnitude, uniform phase.

        Fading changes over half a wavelength: draw once for a static placement, and for each exchange if an
        antenna moves.
        """
        # Most rays belong to unused clusters, or have decayed by 60 dB or more.
        significant = self.mean_power > 1e-6
        m = self.nakagami_m[significant]
        power = rng.standard_gamma(m) * (self.mean_power[significant] / m)
        phase = rng.uniform(0.0, 2.0 * math.pi, power.shape)
        gains = np.zeros(significant.shape, np.complex128)
        gains[significant] = np.sqrt(power) * np.exp(1j * phase)
        return gains


def draw_diffuse_field(
    environment: Environment,
    n: int,
    rng: np.random.Generator,
    delay_factor: NDArray[np.float64] | float = 1.0,
) -> DiffuseField:
    """Draw the diffuse fields of `n` independent placements; `delay_factor`, (n,): factor of the delay of the first cluster.

    Clusters: a Poisson number (at least one), exponential gaps, exponential decay, log-normal power.
    Rays: gaps from a mixture of two exponentials, exponential decay, log-normal Nakagami m
    (802.15.4a report, sections II-C to II-E). The first ray of a cluster is at its start.
    """
    e = environment
    count = np.clip(rng.poisson(e.mean_clusters, n), 1, MAX_CLUSTERS)
    start = np.zeros((n, MAX_CLUSTERS))
    start[:, 1:] = np.cumsum(rng.exponential(1.0 / e.cluster_rate_per_ns, (n, MAX_CLUSTERS - 1)), axis=1)
    cluster_power = np.exp(-start / e.cluster_decay_ns)
    cluster_power *= 10.0 ** (rng.normal(0.0, e.cluster_shadowing_db, start.shape) / 10.0)
    cluster_power *= np.arange(MAX_CLUSTERS) < count[:, None]

    shape = (n, MAX_CLUSTERS, RAYS_PER_CLUSTER)
    rate = np.where(rng.random(shape) < e.ray_mix, *e.ray_rates_per_ns)
    gap = rng.standard_exponential(shape) / rate
    gap[..., 0] = 0.0
    offset = np.cumsum(gap, axis=2)
    ray_decay_ns = e.ray_decay_ns + e.ray_decay_growth * start[..., None]
    power = (cluster_power[..., None] * np.exp(-offset / ray_decay_ns)).reshape(n, -1)
    delay = (start[..., None] + offset).reshape(n, -1)
    delay += (rng.exponential(1.0, n) * e.first_cluster_delay_ns * delay_factor)[:, None]
    m = np.maximum(np.exp(rng.normal(e.nakagami_log_mean, e.nakagami_log_std, power.shape)), 0.5)
    shadowing = rng.normal(0.0, e.shadowing_db, n)
    pattern_loss = rng.gamma(*PATTERN_LOSS_DB, n)
    return DiffuseField(delay, power / power.sum(axis=1, keepdims=True), m, shadowing, pattern_loss)


@dataclass(frozen=True, slots=True)
class Multipath:
    """Received paths of n pairs for 1 mW transmit power.

    Attributes:
        delay_ns: float64 (n, paths), relative to a straight line through air; the direct path is first.
        gain: complex128 (n, paths), field strength: its squared magnitude is a power.
    """

    delay_ns: NDArray[np.float64]
    gain: NDArray[np.complex128]


def direct_power_db(
    distance_m: NDArray[np.float64], loss_db: NDArray[np.float64], channel: Channel
) -> NDArray[np.float64]:
    """Return the power of the direct path relative to the transmit power, dB: Friis minus obstacle loss."""
    return -channel.free_space_loss_1m_db - 20.0 * np.log10(distance_m) - loss_db
