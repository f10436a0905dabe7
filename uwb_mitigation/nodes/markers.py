"""Markers for RViz and Foxglove: anchors, rays to the tags, ellipses and trails."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from uwb_mitigation.measurement import Status
from uwb_mitigation.nodes import topics
from uwb_mitigation.positioning.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.positioning.tracks import Estimate

TRAIL = 400
_ELLIPSE95 = 2.448  # square root of the 95th percentile of chi-squared with two degrees of freedom

# Colour-blind safe palette of Okabe and Ito.
_BLUE = ColorRGBA(r=0.0, g=0.45, b=0.7, a=1.0)
_ORANGE = ColorRGBA(r=0.9, g=0.62, b=0.0, a=0.9)
_GREY = ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.7)
_SKY = ColorRGBA(r=0.34, g=0.71, b=0.91, a=0.35)


ANCHOR_TYPES = {"markers": MarkerArray, "poses": PoseArray}
"""{prefix of the parameter `anchors`: type of a topic with anchors}."""


def anchors_in(message: Any) -> AnchorMap | None:
    """Return the anchors of a MarkerArray (by marker id) or a PoseArray (by index); None: it has none."""
    if isinstance(message, PoseArray):
        points = {number: pose.position for number, pose in enumerate(message.poses)}
    else:
        added = [each for each in message.markers if each.action == Marker.ADD and each.id >= 0]
        points = {each.id: each.pose.position for each in reversed(added)}
    found = [Anchor(number, (point.x, point.y, point.z)) for number, point in sorted(points.items())]
    found = [each for each in found if np.isfinite(each.position).all()]
    return AnchorMap(found[:MAX_ANCHORS], "anchors") if found else None


class TagPicture:
    """State of one tag for its markers.

    Attributes:
        estimate: the latest estimate. trail: earlier positions.
        statuses: status of the latest range of each anchor, {row: status}.
    """

    def __init__(self) -> None:
        self.estimate: Estimate | None = None
        self.trail: deque[tuple[float, float, float]] = deque(maxlen=TRAIL)
        self.statuses: dict[int, Status] = {}

    def add(self, estimate: Estimate) -> None:
        x, y, z = estimate.position.tolist()
        self.estimate = estimate
        self.trail.append((x, y, z))


def anchor_markers(anchors: AnchorMap, frame: str, stamp_ns: int) -> list[Any]:
    """Return a sphere and a label for every anchor."""
    found = []
    for row, anchor in enumerate(anchors.anchors):
        pose = Pose(position=_point(anchor.position), orientation=Quaternion(w=1.0))
        size = max(0.2, 2.0 * anchor.sd)
        ball = _marker("anchors", row, Marker.SPHERE, frame, stamp_ns, _BLUE)
        ball.pose, ball.scale = pose, Vector3(x=size, y=size, z=size)
        # RViz does not draw this text; programs read the id of the anchor from it.
        ball.text = str(anchor.id)
        text = _marker("names", row, Marker.TEXT_VIEW_FACING, frame, stamp_ns, _GREY)
        x, y, z = anchor.position
        text.pose = Pose(position=_point((x, y, z + 0.3)), orientation=Quaternion(w=1.0))
        text.scale, text.text = Vector3(z=0.25), str(anchor)
        found += [ball, text]
    return found


def tag_markers(
    picture: TagPicture, received: list[int], anchors: AnchorMap, frame: str, number: int, stamp_ns: int
) -> list[Any]:
    """Return rays to the ranged anchors (blue: corrected range), the 95 % ellipse and the trail."""
    estimate = picture.estimate
    if estimate is None:
        return []
    rays = _marker("rays", number, Marker.LINE_LIST, frame, stamp_ns, _GREY)
    rays.scale.x = 0.02
    here = _point(estimate.position.tolist())
    for row in received:
        colour = _BLUE if picture.statuses.get(row) is Status.OK else _ORANGE
        rays.points += [_point(anchors.anchors[row].position), here]
        rays.colors += [colour, colour]
    values, vectors = np.linalg.eigh(estimate.covariance[:2, :2])
    small, large = 2.0 * _ELLIPSE95 * np.sqrt(np.maximum(values, 1e-6))
    angle = float(np.arctan2(vectors[1, 1], vectors[0, 1]))
    ellipse = _marker("ellipses", number, Marker.CYLINDER, frame, stamp_ns, _SKY)
    turned = Quaternion(z=float(np.sin(angle / 2)), w=float(np.cos(angle / 2)))
    ellipse.pose = Pose(position=here, orientation=turned)
    ellipse.scale = Vector3(x=float(large), y=float(small), z=0.02)
    trail = _marker("trails", number, Marker.LINE_STRIP, frame, stamp_ns, _GREY)
    trail.scale.x = 0.03
    trail.points = [_point(place) for place in picture.trail]
    return [rays, ellipse, trail]


def _marker(namespace: str, number: int, kind: int, frame: str, stamp_ns: int, colour: ColorRGBA) -> Any:
    return Marker(
        header=topics.header(stamp_ns, frame),
        ns=namespace,
        id=number,
        type=kind,
        action=Marker.ADD,
        pose=Pose(orientation=Quaternion(w=1.0)),
        color=colour,
    )


def _point(place: Any) -> Point:
    x, y, z = place
    return Point(x=float(x), y=float(y), z=float(z))
