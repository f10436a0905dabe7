"""Positions of anchors as latitude, longitude and height on the WGS84 ellipsoid."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwb_mitigation.errors import ParameterError

_A, _F = 6_378_137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)
"""Semi-major axis (m), flattening and squared eccentricity of WGS84."""

_ITERATIONS = 5


def parse_origin(text: str) -> tuple[float, float, float]:
    """Read `LATITUDE,LONGITUDE,ALTITUDE` in degrees and metres; raise ParameterError for other texts."""
    try:
        latitude, longitude, altitude = map(float, text.split(","))
        if abs(latitude) < 90 and abs(longitude) <= 180 and abs(altitude) < 1e5:
            return latitude, longitude, altitude
    except ValueError:
        pass
    valid = "LATITUDE,LONGITUDE,ALTITUDE in degrees and m, such as 47.3977,8.5456,488.0"
    raise ParameterError(f"parameter origin = {text!r:.60}", valid=valid)


def to_geodetic(east_north_up: ArrayLike, origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Convert positions in east, north, up of an origin.

    Args:
        east_north_up: (n, 3), m.
        origin: latitude and longitude in degrees, and height in m.

    Returns:
        (n, 3): latitude and longitude in degrees, and height in m above the surface to which the origin's height refers.
    """
    latitude, longitude = np.radians(origin[:2])
    sin, cos, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    # The axes east, north and up, and the origin, in the earth-centred frame.
    axes = np.array(
        [[-sin_lon, cos_lon, 0], [-sin * cos_lon, -sin * sin_lon, cos], [cos * cos_lon, cos * sin_lon, sin]]
    )
    normal = _A / np.sqrt(1 - _E2 * sin**2)
    centre = [normal + origin[2], normal + origin[2], (1 - _E2) * normal + origin[2]] * axes[2]
    x, y, z = (centre + np.asarray(east_north_up, np.float64) @ axes).T
    # Fixed-point iteration for the latitude; near the surface each step reduces the error by a factor of 1/150.
    distance, phi = np.hypot(x, y), np.full(len(x), latitude)
    for _ in range(_ITERATIONS):
        normal = _A / np.sqrt(1 - _E2 * np.sin(phi) ** 2)
        phi = np.arctan2(z + _E2 * normal * np.sin(phi), distance)
    height = distance * np.cos(phi) + z * np.sin(phi) - _A * np.sqrt(1 - _E2 * np.sin(phi) ** 2)
    return np.stack([np.degrees(phi), np.degrees(np.arctan2(y, x)), height], axis=1)
