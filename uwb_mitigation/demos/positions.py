"""The demo's last table: errors of positions from raw ranges, from corrected ranges, and of the locator."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rich.table import Table
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.monitor import Monitor
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.start import snapshot
from uwb_mitigation.positioning.tracks import Ranges, Track, TruePath, track_errors


class Positions:
    """Collects ranges, true positions and poses of one tag.

    Args:
        node: subscribes.
        anchors: at the height of the tag.
    """

    def __init__(self, node: Monitor, anchors: AnchorMap) -> None:
        self._anchors = anchors
        self._ranges: list[tuple[int, int, float, float]] = []
        self._truth: list[Any] = []
        self._poses: list[Any] = []
        for kind, topic, callback in (
            (RangeCorrected, topics.RANGE_CORRECTED, self._on_range),
            (Odometry, topics.ODOMETRY_TRUTH, self._truth.append),
            (PoseWithCovarianceStamped, topics.POSE, self._poses.append),
        ):
            node.create_subscription(kind, topic, callback, topics.RANGES)

    def table(self) -> Table | None:
        """Return the horizontal errors; None if there is too little data."""
        truth, poses = _path(self._truth), _path(self._poses)
        if len(self._ranges) < 2 or len(truth) < 2:
            return None
        unknown = np.full((len(poses), 6, 6), np.nan)
        tracks = {
            "raw ranges, least squares": self._snapshots(2),
            "corrected ranges, least squares": self._snapshots(3),
            "corrected ranges, locator": Track(poses.stamp_ns, poses.position, unknown[:, 0, :3], unknown),
        }
        table = Table("horizontal position error, m", title_justify="left")
        for name in ("positions", "RMSE", "median", "p95"):
            table.add_column(name, justify="right")
        for name, track in tracks.items():
            errors = track_errors(track, truth)
            figures = (f"{value:.3f}" for value in (errors.rmse, errors.median, errors.p95))
            table.add_row(name, str(errors.epochs), *(figures if errors.epochs else "---"))
        return table

    def _snapshots(self, column: int) -> Track:
        rows = sorted(row for row in self._ranges if np.isfinite(row[column]))
        unknown = np.full(len(rows), np.nan)
        ranges = Ranges(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.intp),
            np.array([row[column] for row in rows], np.float64),
            unknown,
            unknown,
        )
        return snapshot(self._anchors, ranges, Height(0.0))

    def _on_range(self, message: RangeCorrected) -> None:
        row = self._anchors.index.get(message.anchor_id)
        if row is not None:
            self._ranges.append((_stamp_ns(message), row, message.range_raw, message.range))


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def _path(messages: list[Any]) -> TruePath:
    positions = [(_stamp_ns(message), message.pose.pose.position) for message in messages]
    rows = sorted({(stamp_ns, at.x, at.y, at.z) for stamp_ns, at in positions})
    return TruePath(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1:] for row in rows], np.float64).reshape(-1, 3),
    )
