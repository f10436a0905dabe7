"""Input and output of estimation: ranges in columns, estimates, tracks, true positions, and the errors of tracks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import protection_levels

_Columns = TypeVar("_Columns", bound="Columns")


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Base of classes with n rows in the order of their times: arrays (n, ...).

    Attributes:
        stamp_ns: int64 (n,).
    """

    stamp_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self: _Columns, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> _Columns:
        """Return the rows at `index`."""
        columns = {one.name: getattr(self, one.name) for one in fields(self)}
        taken = {name: column[index] for name, column in columns.items() if isinstance(column, np.ndarray)}
        return replace(self, **taken)

    def reversed(self: _Columns, end_ns: int) -> _Columns:
        """Return the rows backwards in time, from `end_ns` on."""
        back = self.take(slice(None, None, -1))
        return replace(back, stamp_ns=end_ns - back.stamp_ns)


def rows_of(*columns: NDArray[Any]) -> Iterator[tuple[Any, ...]]:
    """Return the rows of arrays (n, ...) as Python numbers and lists."""
    return zip(*(column.tolist() for column in columns), strict=True)


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(Columns):
    """n ranges of one tag.

    Attributes:
        anchor: int (n,), rows of an `AnchorMap`.
        range_m: float64 (n,), finite.
        variance_m2, rx_power_dbm: float64 (n,); NaN: unknown.
        tag_id: of all of them.
    """

    anchor: NDArray[np.intp]
    range_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]
    rx_power_dbm: NDArray[np.float64]
    tag_id: int = 0

    @classmethod
    def joined(cls, parts: Sequence[Ranges]) -> Ranges:
        """Concatenate ranges; the tag id is 0."""
        names = ("stamp_ns", "anchor", "range_m", "variance_m2", "rx_power_dbm")
        columns: Any = (np.concatenate([getattr(one, name) for one in parts]) for name in names)
        return cls(*columns)


@dataclass(frozen=True, slots=True, eq=False)
class Heading:
    """Heading of the robot that carries a tag.

    Attributes:
        yaw: rad, in the anchors' frame.
        covariance: float64 (4,), of the yaw with the x, y and z of the tag (m rad), and its variance (rad^2).
    """

    yaw: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Position and velocity of a tag at one time.

    Attributes:
        stamp_ns: its time.
        position, velocity: float64 (3,), m and m/s, in the anchors' frame.
        covariance: float64 (6, 6), of position and velocity.
        heading: None: unknown.
    """

    stamp_ns: int
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    covariance: NDArray[np.float64]
    heading: Heading | None = None


_UNKNOWN_HEADING = (math.nan,) * 5


@dataclass(frozen=True, slots=True, eq=False)
class Track(Columns):
    """n estimates.

    Attributes:
        position, velocity: float64 (n, 3).
        covariance: float64 (n, 6, 6), of position and velocity.
        yaw: float64 (n, 5), heading of the robot (rad) and its covariance as in `Heading`; NaN: unknown.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    covariance: NDArray[np.float64]
    yaw: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 5)))

    def __post_init__(self) -> None:
        if len(self.yaw) != len(self.stamp_ns):
            object.__setattr__(self, "yaw", np.full((len(self.stamp_ns), 5), np.nan))

    @classmethod
    def of(cls, estimates: list[Estimate]) -> Track:
        """Return estimates as a track."""
        return cls(
            np.array([e.stamp_ns for e in estimates], np.int64),
            np.array([e.position for e in estimates], np.float64).reshape(-1, 3),
            np.array([e.velocity for e in estimates], np.float64).reshape(-1, 3),
            np.array([e.covariance for e in estimates], np.float64).reshape(-1, 6, 6),
            np.array(
                [
                    _UNKNOWN_HEADING if e.heading is None else (e.heading.yaw, *e.heading.covariance)
                    for e in estimates
                ],
                np.float64,
            ).reshape(-1, 5),
        )

    def __iter__(self) -> Iterator[Estimate]:
        columns = (self.stamp_ns.tolist(), self.position, self.velocity, self.covariance, self.yaw)
        for stamp_ns, position, velocity, covariance, yaw in zip(*columns, strict=True):
            heading = Heading(float(yaw[0]), yaw[1:]) if np.isfinite(yaw[0]) else None
            yield Estimate(stamp_ns, position, velocity, covariance, heading)


@dataclass(frozen=True, slots=True, eq=False)
class TruePath(Columns):
    """True positions of a tag: float64 (n, 3) positions in m, and yaws (n,) in rad if known."""

    position: NDArray[np.float64]
    yaw: NDArray[np.float64] | None = None

    def at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return positions float64 (k, 3) at other times, by interpolation; NaN outside, and in gaps of over 1 s."""
        if len(self) == 0:
            return np.full((len(stamp_ns), 3), np.nan)
        # Relative: a float64 resolves seconds since the epoch to a fraction of a microsecond only.
        own, wanted = (stamps - self.stamp_ns[0] for stamps in (self.stamp_ns, stamp_ns))
        found = np.stack([np.interp(wanted, own, axis, np.nan, np.nan) for axis in self.position.T], axis=1)
        after = np.clip(np.searchsorted(own, wanted), 1, max(len(own) - 1, 1))
        if len(own) > 1:
            found[own[after] - own[after - 1] > 1_000_000_000] = np.nan
        return found

    def yaw_at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return yaws float64 (k,) at other times, by interpolation; NaN where unknown."""
        if self.yaw is None:
            return np.full(len(stamp_ns), np.nan)
        circle = np.stack([np.cos(self.yaw), np.sin(self.yaw), np.zeros(len(self))], axis=1)
        cosine, sine, _ = TruePath(self.stamp_ns, circle).at(stamp_ns).T
        return np.asarray(np.arctan2(sine, cosine), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Heights(Columns):
    """Measured heights of a tag in the anchors' frame.

    Attributes:
        height_m: float64 (n,), finite.
        variance_m2: float64 (n,), positive.
    """

    height_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]

    def at(self, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return height and variance at each stamp, linearly interpolated; NaN outside and in gaps of over 1 s."""
        columns = np.stack([self.height_m, self.variance_m2, np.zeros(len(self))], axis=1)
        found = TruePath(self.stamp_ns, columns).at(stamp_ns)
        return found[:, 0], found[:, 1]


@dataclass(frozen=True, slots=True, eq=False)
class Odometry(Columns):
    """Motion of a robot's base in the plane, measured by its wheels or by another sensor.

    Attributes:
        pose: float64 (n, 3), x and y in m and yaw in rad, in the odometry frame, which drifts; NaN: unknown.
        pose_covariance: float64 (n, 3, 3); zero: unknown.
        twist: float64 (n, 3), velocities in m/s and yaw rate in rad/s, in the axes of the base.
        twist_covariance: float64 (n, 3, 3); zero: unknown.
    """

    pose: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    twist: NDArray[np.float64]
    twist_covariance: NDArray[np.float64]

    def reversed(self, end_ns: int) -> Odometry:
        """Return the motion backwards in time, from `end_ns` on."""
        return replace(Columns.reversed(self, end_ns), twist=-self.twist[::-1])


@dataclass(frozen=True, slots=True, eq=False)
class Imu(Columns):
    """Yaw rates, and if known yaws, of an IMU whose z axis points up.

    Attributes:
        yaw_rate: float64 (n,), rad/s. yaw_rate_variance: float64 (n,), rad^2/s^2; zero: unknown.
        yaw: float64 (n,), rad; NaN: unknown. yaw_variance: float64 (n,), rad^2; zero: unknown.
    """

    yaw_rate: NDArray[np.float64]
    yaw_rate_variance: NDArray[np.float64]
    yaw: NDArray[np.float64]
    yaw_variance: NDArray[np.float64]

    def reversed(self, end_ns: int) -> Imu:
        """Return the rotation backwards in time, from `end_ns` on."""
        return replace(Columns.reversed(self, end_ns), yaw_rate=-self.yaw_rate[::-1])


ELLIPSE95 = 5.991
"""95th percentile of chi-squared with two degrees of freedom."""


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Horizontal errors of a track, in m unless stated otherwise.

    Attributes:
        epochs: number of estimates with a known true position.
        rmse, median, p95: of the horizontal distance to the truth.
        coverage95: share of truths inside the 95 % ellipses; NaN without covariances.
        nees_per_dof: mean normalised estimation error squared, over its two degrees of freedom: 1 is consistent,
            more is overconfident (Bar-Shalom et al., section 5.4); NaN without covariances.
        exceeded: share of epochs with an error in x or y above its protection level; NaN without covariances.
        height_rmse: RMSE of z.
        heading_rmse_deg: RMSE of the yaw where it is known, degrees; NaN: never, or without a true yaw.
        heading_found_after_s: time from the first estimate to the first one with a yaw; NaN as above.
    """

    epochs: int
    rmse: float
    median: float
    p95: float
    coverage95: float
    nees_per_dof: float
    exceeded: float
    height_rmse: float
    heading_rmse_deg: float = math.nan
    heading_found_after_s: float = math.nan

    def as_json(self) -> dict[str, float | int | None]:
        """Return the keys of `track --json`; unknown values are null."""
        values = {_JSON_KEYS.get(key, key): value for key, value in asdict(self).items()}
        return {name: value if math.isfinite(value) else None for name, value in values.items()}


_JSON_KEYS = {
    "rmse": "horizontal_rmse_m",
    "median": "median_m",
    "p95": "p95_m",
    "exceeded": "protection_exceeded",
    "height_rmse": "height_rmse_m",
}
NO_ERRORS = TrackErrors(0, *(math.nan,) * 7)


def track_errors(track: Track, truth: TruePath, offset_ns: int = 0) -> TrackErrors:
    """Return the errors of a track at its own times.

    Args:
        track: estimates; NaN covariances are not evaluated.
        truth: true positions.
        offset_ns: added to the track's stamps to get times of the truth.
    """
    true = truth.at(track.stamp_ns + offset_ns)
    known = np.isfinite(true).all(axis=1)
    if not known.any():
        return NO_ERRORS
    errors = errors_of(track.position[known], track.covariance[known], true[known])
    of_yaw = np.angle(np.exp(1j * (track.yaw[:, 0] - truth.yaw_at(track.stamp_ns + offset_ns))))
    of_yaw = of_yaw[np.isfinite(of_yaw)]
    if not len(of_yaw):
        return errors
    first = int(np.isfinite(track.yaw[:, 0]).argmax())
    return replace(
        errors,
        heading_rmse_deg=math.degrees(np.sqrt(np.mean(of_yaw**2))),
        heading_found_after_s=float(track.stamp_ns[first] - track.stamp_ns[0]) / 1e9,
    )


def errors_of(
    position: NDArray[np.float64], covariance: NDArray[np.float64], true: NDArray[np.float64]
) -> TrackErrors:
    """Return the errors of n positions (n, 3) with covariances (n, d, d) from true positions (n, 3)."""
    error = position[:, :2] - true[:, :2]
    distance = np.hypot(*error.T)
    plane = covariance[:, :2, :2]
    coverage = nees = exceeded = math.nan
    if len(error) and np.isfinite(plane).all():
        squared = np.einsum("ni,ni->n", error, np.linalg.solve(plane, error[..., None])[..., 0])
        coverage = float((squared <= ELLIPSE95).mean())
        nees = float(squared.mean() / 2.0)
        exceeded = float((np.abs(error) > protection_levels(plane)).any(axis=1).mean())
    return TrackErrors(
        len(error),
        float(np.sqrt(np.mean(distance**2))),
        float(np.median(distance)),
        float(np.percentile(distance, 95)),
        coverage,
        nees,
        exceeded,
        float(np.sqrt(np.mean((position[:, 2] - true[:, 2]) ** 2))),
    )
