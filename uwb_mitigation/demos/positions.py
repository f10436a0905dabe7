"""The demo's last table: where the tag was by raw ranges, by corrected ones, and by the locator, beside the truth."""

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
from uwb_mitigation.positioning.tracks import Ranges, Track, TrackErrors, TruePath, track_errors


class Positions:
    """Collects what passes on the topics of one tag.

    Args:
        node: to subscribe with.
        anchors: where they are; the tag is level with them.
    """

    def __init__(self, node: Monitor, anchors: AnchorMap) -> None:
        self._anchors = anchors
        self._ranges: list[tuple[int, int, float, float]] = []
        self._truth: list[tuple[int, float, float, float]] = []
        self._poses: list[tuple[int, float, float, float]] = []
        node.create_subscription(RangeCorrected, topics.RANGE_CORRECTED, self._on_range, topics.RANGES)
        node.create_subscription(Odometry, topics.ODOMETRY_TRUTH, self._on_truth, topics.RANGES)
        node.create_subscription(PoseWithCovarianceStamped, topics.POSE, self._on_pose, topics.RANGES)

    def table(self) -> Table | None:
        """Horizontal errors; None where too little came."""
        truth = _path(self._truth)
        if len(self._ranges) < 2 or len(truth) < 2:
            return None
        rows: list[tuple[str, TrackErrors]] = []
        for name, column in (("raw ranges, least squares", 2), ("corrected ranges, least squares", 3)):
            rows.append((name, track_errors(self._snapshots(column), truth)))
        poses = _path(self._poses)
        nothing = np.full((len(poses), 6, 6), np.nan)
        live = Track(poses.stamp_ns, poses.position, nothing[:, 0, :3], nothing)
        rows.append(("corrected ranges, locator", track_errors(live, truth)))
        table = Table("horizontal position error, m", title_justify="left")
        for name in ("positions", "RMSE", "median", "p95"):
            table.add_column(name, justify="right")
        for name, errors in rows:
            figures = (f"{value:.3f}" for value in (errors.rmse, errors.median, errors.p95))
            table.add_row(name, str(errors.epochs), *(figures if errors.epochs else "---"))
        return table

    def _snapshots(self, column: int) -> Track:
        rows = sorted(row for row in self._ranges if np.isfinite(row[column]))
        nothing = np.full(len(rows), np.nan)
        ranges = Ranges(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.intp),
            np.array([row[column] for row in rows], np.float64),
            nothing,
            nothing,
        )
        return snapshot(self._anchors, ranges, Height(0.0))

    def _on_range(self, message: RangeCorrected) -> None:
        row = self._anchors.index.get(message.anchor_id)
        if row is not None:
            self._ranges.append((_stamp(message), row, message.range_raw, message.range))

    def _on_truth(self, message: Odometry) -> None:
        self._truth.append(_place(message))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._poses.append(_place(message))


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def _place(message: Any) -> tuple[int, float, float, float]:
    position = message.pose.pose.position
    return _stamp(message), position.x, position.y, position.z


def _path(rows: list[tuple[int, float, float, float]]) -> TruePath:
    rows = sorted(set(rows))
    return TruePath(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1:] for row in rows], np.float64).reshape(-1, 3),
    )
