"""Antenna pairs at given positions: obstacles, shared diffuse fields, and the received paths."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.simulation import channel
from uwb_mitigation.simulation.scene import DirectPath, Point

BORDER_M = 0.2
MIN_DISTANCE_M = 0.5

Environments = tuple[channel.Environment, channel.Environment]
"""Diffuse fields for LOS and NLOS."""


@dataclass(frozen=True, slots=True)
class AntennaPairs:
    """n antenna pairs before the radio model.

    Attributes:
        anchor, tag: float64 (n, 2), m.
        path: the obstacles between them.
        environments, fields: the diffuse fields for LOS and NLOS.
        field_of: int (n,), row of the fields for each link.
        stationary: fading is drawn once per field; in motion, once per link.
    """

    anchor: NDArray[np.float64]
    tag: NDArray[np.float64]
    path: DirectPath
    environments: Environments
    fields: tuple[channel.DiffuseField, channel.DiffuseField]
    field_of: NDArray[np.intp]
    stationary: bool

    @property
    def distance_m(self) -> NDArray[np.float64]:
        """Straight-line distances, (n,)."""
        return np.asarray(np.hypot(*(self.tag - self.anchor).T), np.float64)

    def take(self, fields: NDArray[np.intp], field_of: NDArray[np.intp]) -> AntennaPairs:
        """Return pairs over some of the fields, with new row numbers in `field_of`; field k is that of link k here."""
        pairs, (los, nlos) = fields[field_of], self.fields
        ends, drawn = (self.anchor[pairs], self.tag[pairs]), (los.take(fields), nlos.take(fields))
        path = self.path.take(pairs)
        return AntennaPairs(*ends, path, self.environments, drawn, field_of, self.stationary)

    def moved(
        self,
        fields: tuple[channel.DiffuseField, channel.DiffuseField],
        progress: NDArray[np.float64],
        changes_at: NDArray[np.float64],
    ) -> AntennaPairs:
        """Return the pairs on the way from their fields to other ones in the same rows; see `DiffuseField.moved`."""
        row = self.field_of
        los, nlos = (
            old.take(row).moved(new.take(row), progress, changes_at[row])
            for old, new in zip(self.fields, fields, strict=True)
        )
        return replace(self, fields=(los, nlos), field_of=np.arange(len(row)))

    def multipath(self, rng: np.random.Generator) -> channel.Multipath:
        """Return the received paths of each link; a link without obstacles uses the LOS environment."""
        path, distance = self.path, self.distance_m
        shape = len(distance), 1 + self.fields[0].delay_ns.shape[1]
        delay, gain = np.empty(shape), np.empty(shape, np.complex128)
        for environment, field, nlos in zip(self.environments, self.fields, (False, True), strict=True):
            (rows,) = np.nonzero((path.crossings > 0) == nlos)
            field_rows = self.field_of[rows]
            rays = field.take(field_rows)
            fading = field.fade(rng)[field_rows] if self.stationary else rays.fade(rng)
            received = propagate(distance[rows], path.take(rows), environment, rays, fading, rng)
            delay[rows], gain[rows] = received.delay_ns, received.gain
        return channel.Multipath(delay, gain)


def propagate(
    distance_m: NDArray[np.float64],
    path: DirectPath,
    environment: channel.Environment,
    field: channel.DiffuseField,
    fading: NDArray[np.complex128],
    rng: np.random.Generator,
) -> channel.Multipath:
    """Join the direct path and the diffuse field of n pairs.

    For LOS, the environment's path loss gives the power of all paths, so the diffuse field has this power minus
    that of the direct path, but at least a twentieth (at short distances the direct path can have all of it). For
    NLOS, the environment's path loss is that of the diffuse field itself.

    Args:
        distance_m: straight-line distance, float64 (n,).
        path: obstacles between the antennas.
        environment: environment of all pairs.
        field: diffuse fields of n pairs; see `draw_fields`.
        fading: gains of the rays, complex128 (n, rays).
        rng: source of the phase of the direct path.

    Raises:
        ParameterError: a distance is not finite and positive.
    """
    if not bool(np.all(np.isfinite(distance_m) & (distance_m > 0))):
        raise ParameterError("distance that is not finite and positive", where="channel", valid="> 0 m")
    direct = 10.0 ** (
        channel.direct_power_db(distance_m, path.loss_db + field.pattern_loss_db, path.channel) / 10.0
    )
    diffuse = 10.0 ** (-environment.path_loss_db(distance_m, path.channel) / 10.0)
    if environment.first_cluster_delay_ns == 0.0:
        diffuse = np.maximum(diffuse - direct, 0.05 * diffuse)
    diffuse = diffuse * 10.0 ** (field.shadowing_db / 10.0)
    phase = rng.uniform(0.0, 2.0 * math.pi, len(distance_m))
    gain = np.concatenate(
        [(np.sqrt(direct) * np.exp(1j * phase))[:, None], np.sqrt(diffuse)[:, None] * fading], axis=1
    )
    delay = np.concatenate(
        [(path.excess_m / channel.SPEED_OF_LIGHT_M_PER_NS)[:, None], field.delay_ns], axis=1
    )
    return channel.Multipath(delay, gain)


def draw_fields(
    environments: Environments,
    n: int,
    rng: np.random.Generator,
    delay_factor: NDArray[np.float64] | float = 1.0,
) -> tuple[channel.DiffuseField, channel.DiffuseField]:
    """Draw the diffuse fields of n placements for LOS and NLOS; see `draw_diffuse_field` for `delay_factor`."""
    los, nlos = (channel.draw_diffuse_field(one, n, rng, delay_factor) for one in environments)
    return los, nlos


def place(size: Point, n: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw n pairs of positions inside a rectangle, float64 (n, 2) each; pairs too close are drawn again."""
    pair = np.empty((n, 2, 2))
    again = np.ones(n, np.bool_)
    while again.any():
        pair[again] = rng.uniform((BORDER_M, BORDER_M), np.subtract(size, BORDER_M), (int(again.sum()), 2, 2))
        again = np.hypot(*(pair[:, 0] - pair[:, 1]).T) < MIN_DISTANCE_M
    return pair[:, 0], pair[:, 1]


def label(nlos: bool, direct_above_threshold: bool) -> str:
    """Return the propagation condition of a link."""
    if not nlos:
        return "LOS"
    return "NLOS" if direct_above_threshold else "NDP NLOS"
