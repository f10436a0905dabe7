"""Input and output of estimation, as arrays over time: ranges, estimates, tracks, true positions and poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

from uwb_mitigation.types.columns import Columns
from uwb_mitigation.types.stamps import NS_PER_S

_Series = TypeVar("_Series", bound="TimeSeries")


@dataclass(frozen=True, slots=True, eq=False)
class TimeSeries(Columns):
    """Base of classes with n rows in the order of their times: arrays (n, ...).

    Attributes:
        stamp_ns: int64 (n,).
    """

    stamp_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def reversed(self: _Series, end_ns: int) -> _Series:
        """Return the rows backwards in time, from `end_ns` on."""
        back = self.take(slice(None, None, -1))
        return replace(back, stamp_ns=end_ns - back.stamp_ns)


def rows_of(*columns: NDArray[Any]) -> Iterator[tuple[Any, ...]]:
    """Return the rows of arrays (n, ...) as Python numbers and lists."""
    return zip(*(column.tolist() for column in columns), strict=True)


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(TimeSeries):
    """n ranges of one tag.

    Attributes:
        anchor: int (n,), rows of an `AnchorMap`.
        range_m: float64 (n,), finite.
        variance_m2, rx_power_dbm: float64 (n,); NaN: unknown.
        tag_id: of all of them.
        is_corrected: whether a model corrected a range, of each bool (n,) or of all.
    """

    anchor: NDArray[np.intp]
    range_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]
    rx_power_dbm: NDArray[np.float64]
    tag_id: int = 0
    is_corrected: NDArray[np.bool_] | bool = False

    @staticmethod
    def of_tags(tags: Sequence[Ranges]) -> Ranges:
        """Concatenate the ranges of tags; the tag id is 0."""
        flags = (np.broadcast_to(ranges.is_corrected, len(ranges)) for ranges in tags)
        rows = [replace(ranges, is_corrected=flag) for ranges, flag in zip(tags, flags, strict=True)]
        return replace(Ranges.joined(rows), tag_id=0)


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
class Track(TimeSeries):
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

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """Stamps in s, float64 (n,); this and the next two names are those of evo."""
        return self.stamp_ns / NS_PER_S

    @property
    def positions_xyz(self) -> NDArray[np.float64]:
        """Positions in m, float64 (n, 3)."""
        return self.position

    @property
    def orientations_quat_wxyz(self) -> NDArray[np.float64]:
        """Orientations of the robot, unit quaternions float64 (n, 4); the identity where the yaw is unknown."""
        half, zero = np.nan_to_num(self.yaw[:, 0]) / 2.0, np.zeros(len(self))
        return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)

    @classmethod
    def from_estimates(cls, estimates: list[Estimate]) -> Track:
        """Return estimates as a track."""
        headings = [
            _UNKNOWN_HEADING if e.heading is None else (e.heading.yaw, *e.heading.covariance.tolist())
            for e in estimates
        ]
        return cls(
            np.array([e.stamp_ns for e in estimates], np.int64),
            np.array([e.position for e in estimates], np.float64).reshape(-1, 3),
            np.array([e.velocity for e in estimates], np.float64).reshape(-1, 3),
            np.array([e.covariance for e in estimates], np.float64).reshape(-1, 6, 6),
            np.array(headings, np.float64).reshape(-1, 5),
        )

    def __iter__(self) -> Iterator[Estimate]:
        columns = (self.stamp_ns.tolist(), self.position, self.velocity, self.covariance, self.yaw)
        for stamp_ns, position, velocity, covariance, yaw in zip(*columns, strict=True):
            heading = Heading(float(yaw[0]), yaw[1:]) if np.isfinite(yaw[0]) else None
            yield Estimate(stamp_ns, position, velocity, covariance, heading)


@dataclass(frozen=True, slots=True, eq=False)
class TruePath(TimeSeries):
    """True positions of a tag: float64 (n, 3) positions in m, and yaws (n,) in rad if known."""

    position: NDArray[np.float64]
    yaw: NDArray[np.float64] | None = None

    def position_at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return positions float64 (k, 3) at other times, by interpolation; NaN outside, and in gaps of over 1 s."""
        if len(self) == 0:
            return np.full((len(stamp_ns), 3), np.nan)
        # Relative: a float64 resolves seconds since the epoch to a fraction of a microsecond only.
        own_ns, query_ns = (stamps - self.stamp_ns[0] for stamps in (self.stamp_ns, stamp_ns))
        position = np.stack(
            [np.interp(query_ns, own_ns, axis, np.nan, np.nan) for axis in self.position.T], axis=1
        )
        after = np.clip(np.searchsorted(own_ns, query_ns), 1, max(len(own_ns) - 1, 1))
        if len(own_ns) > 1:
            position[own_ns[after] - own_ns[after - 1] > NS_PER_S] = np.nan
        return position

    def yaw_at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return yaws float64 (k,) at other times, by interpolation; NaN where unknown."""
        if self.yaw is None:
            return np.full(len(stamp_ns), np.nan)
        circle = np.stack([np.cos(self.yaw), np.sin(self.yaw), np.zeros(len(self))], axis=1)
        cosine, sine, _ = TruePath(self.stamp_ns, circle).position_at(stamp_ns).T
        return np.asarray(np.arctan2(sine, cosine), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class TagRecording:
    """The ranges of one tag in a recording.

    Attributes:
        raw: ranges as measured, with unknown variances.
        ranges: corrected ranges with their variances, if there are any; otherwise the raw ranges.
        corrected: whether `ranges` differ from the raw ranges.
        truth: true positions; empty: unknown.
    """

    tag_id: int
    raw: Ranges
    ranges: Ranges
    corrected: bool
    truth: TruePath


@dataclass(frozen=True, slots=True, eq=False)
class Heights(TimeSeries):
    """Measured heights of a tag in the anchors' frame.

    Attributes:
        height_m: float64 (n,), finite.
        variance_m2: float64 (n,), positive.
    """

    height_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]

    def height_at(self, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return height and variance at each stamp, linearly interpolated; NaN outside and in gaps of over 1 s."""
        columns = np.stack([self.height_m, self.variance_m2, np.zeros(len(self))], axis=1)
        interpolated = TruePath(self.stamp_ns, columns).position_at(stamp_ns)
        return interpolated[:, 0], interpolated[:, 1]


@dataclass(frozen=True, slots=True, eq=False)
class Odometry(TimeSeries):
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

    @classmethod
    def integrated(cls, stamp_ns: NDArray[np.int64], twist: NDArray[np.float64]) -> Odometry:
        """Return the motion of velocities (n, 3), each of the interval that ends at its stamp, without covariances."""
        step = np.diff(stamp_ns, prepend=stamp_ns[:1]) / 1e9
        yaw = np.cumsum(twist[:, 2] * step)
        middle = yaw - twist[:, 2] * step / 2
        x = np.cumsum((twist[:, 0] * np.cos(middle) - twist[:, 1] * np.sin(middle)) * step)
        y = np.cumsum((twist[:, 0] * np.sin(middle) + twist[:, 1] * np.cos(middle)) * step)
        unknown = np.zeros((len(stamp_ns), 3, 3))
        return cls(stamp_ns, np.stack([x, y, yaw], axis=1), unknown, twist, unknown)

    def reversed(self, end_ns: int) -> Odometry:
        """Return the motion backwards in time, from `end_ns` on."""
        return replace(TimeSeries.reversed(self, end_ns), twist=-self.twist[::-1])


@dataclass(frozen=True, slots=True, eq=False)
class Imu(TimeSeries):
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
        return replace(TimeSeries.reversed(self, end_ns), yaw_rate=-self.yaw_rate[::-1])


GAP_S = 0.5
"""In longer gaps of the localisation the pose is unknown."""

SMOOTHED_S = 0.2
"""Poses jitter, but less halfway between two of them: without smoothing, such time offsets would look best."""

_MAX_NEIGHBOURS = 20

_WORST_CONDITION = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class PosePath(TimeSeries):
    """Poses of a robot's frame.

    Contains float64 (n, 3) positions in m, and (n, 4) unit quaternions x, y, z, w that rotate the robot's axes to the map's.
    """

    position: NDArray[np.float64]
    orientation: NDArray[np.float64]

    def shifted(self, by_ns: int) -> PosePath:
        """Return the poses at stamps later by the given time."""
        return PosePath(self.stamp_ns + by_ns, self.position, self.orientation)

    def smoothed(self) -> PosePath:
        """Return poses with positions from parabolas through those of `SMOOTHED_S` before and after each (Savitzky and Golay, 1964)."""
        time_s = (self.stamp_ns - self.stamp_ns[0]) / NS_PER_S
        # Sums over neighbours of 1, t, t^2, t^3, t^4, and of the positions times the first three.
        moments, right = np.zeros((len(self), 5)), np.zeros((len(self), 3, 3))
        reach = (
            int(np.max(np.searchsorted(time_s, time_s + SMOOTHED_S, side="right") - np.arange(len(self)))) - 1
        )
        stride = max(1, reach // _MAX_NEIGHBOURS)
        for step in range(-(reach // stride) * stride, reach + 1, stride):
            rows = np.arange(max(-step, 0), len(self) - max(step, 0))
            since = (time_s[rows + step] - time_s[rows]) / SMOOTHED_S
            powers = np.where(np.abs(since)[:, None] <= 1.0, since[:, None] ** np.arange(5), 0.0)
            moments[rows] += powers
            right[rows] += powers[:, :3, None] * self.position[rows + step][:, None]
        normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
        # With duplicate poses there are too few different times for a parabola.
        solvable = (moments[:, 0] >= 5.0) & (np.linalg.cond(normal) < _WORST_CONDITION)
        position = self.position.copy()
        position[solvable] = np.linalg.solve(normal[solvable], right[solvable])[:, 0]
        return PosePath(self.stamp_ns, position, self.orientation)

    @staticmethod
    def merged(paths: Sequence[PosePath]) -> PosePath:
        """Return all poses in the order of time."""
        poses = PosePath.joined(paths)
        return poses.take(np.argsort(poses.stamp_ns, kind="stable"))

    def interpolated(self, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], Rotation]:
        """Return positions (k, 3) and rotations (k,) at stamps; outside, those of the first or last pose.

        Between two poses the quaternion is interpolated linearly and normalised: rotations are small there.
        """
        # The driver needs the other classes of this file, and not SciPy, which imports slowly.
        from scipy.spatial.transform import Rotation

        after = np.searchsorted(self.stamp_ns, stamp_ns).clip(0, len(self) - 1)
        before = np.maximum(after - 1, 0)
        span_ns = np.maximum(self.stamp_ns[after] - self.stamp_ns[before], 1)
        fraction = ((stamp_ns - self.stamp_ns[before]) / span_ns).clip(0.0, 1.0)[:, None]
        position = (1.0 - fraction) * self.position[before] + fraction * self.position[after]
        first, second = self.orientation[before], self.orientation[after]
        second = np.where(np.einsum("ni,ni->n", first, second)[:, None] < 0.0, -second, second)
        return position, Rotation.from_quat((1.0 - fraction) * first + fraction * second)

    def poses_at(
        self, stamp_ns: NDArray[np.int64], later_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (k, 3) and rotation matrices (k, 3, 3) at stamps + `later_s`; NaN outside and in gaps > `GAP_S`."""
        query_ns = stamp_ns + round(later_s * NS_PER_S)
        after = np.searchsorted(self.stamp_ns, query_ns).clip(1, len(self) - 1)
        gap = self.stamp_ns[after] - self.stamp_ns[after - 1] > GAP_S * NS_PER_S
        unknown = (query_ns < self.stamp_ns[0]) | (query_ns > self.stamp_ns[-1]) | gap
        position, rotation = self.interpolated(query_ns)
        matrices = rotation.as_matrix()
        position[unknown], matrices[unknown] = np.nan, np.nan
        return position, matrices
