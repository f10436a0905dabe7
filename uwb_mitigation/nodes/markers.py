"""Markers for RViz and Foxglove: anchors, rays to the tags, ellipses and trails."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.positioning.geometry import horizontal_ellipse
from uwb_mitigation.types.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.tracks import Estimate
from uwb_mitigation.viewer import palette
from uwb_mitigation.viewer.palette import STATUS_LOOKS

TRAIL = 400

SYMBOL_M = 0.12
"""Radius of the symbol of a status."""


def _colour(code: str | None, alpha: float = 1.0) -> ColorRGBA:
    """Convert a colour of the palette; None: the ink of a light background."""
    r, g, b = (int((code or palette.NIGHT)[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return ColorRGBA(r=r, g=g, b=b, a=alpha)


ANCHOR_TYPES = {"markers": MarkerArray, "poses": PoseArray}
"""{prefix of the parameter `anchors`: type of a topic with anchors}."""


def anchors_in(message: Any) -> AnchorMap | None:
    """Return the anchors of a MarkerArray (by marker id) or a PoseArray (by index); None: it has none."""
    if isinstance(message, PoseArray):
        points = {number: pose.position for number, pose in enumerate(message.poses)}
    else:
        added = [marker for marker in message.markers if marker.action == Marker.ADD and marker.id >= 0]
        points = {marker.id: marker.pose.position for marker in reversed(added)}
    anchors = [Anchor(number, (point.x, point.y, point.z)) for number, point in sorted(points.items())]
    anchors = [anchor for anchor in anchors if np.isfinite(anchor.position).all()]
    return AnchorMap(anchors[:MAX_ANCHORS], "anchors") if anchors else None


class TagPicture:
    """State of one tag for its markers.

    Args:
        name: frame of the tag.

    Attributes:
        estimate: the latest estimate. trail: earlier positions.
        statuses: status of the latest range of each anchor, {row: status}.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.estimate: Estimate | None = None
        self.trail: deque[tuple[float, float, float]] = deque(maxlen=TRAIL)
        self.statuses: dict[int, Status] = {}

    def add(self, estimate: Estimate) -> None:
        x, y, z = estimate.position.tolist()
        self.estimate = estimate
        self.trail.append((x, y, z))


def anchor_markers(anchors: AnchorMap, frame: str, stamp_ns: int) -> list[Any]:
    """Return a sphere and a label for every anchor."""
    markers = []
    for row, anchor in enumerate(anchors.anchors):
        pose = Pose(position=_point(anchor.position), orientation=Quaternion(w=1.0))
        size = max(0.2, 2.0 * anchor.sd)
        ball = _marker("anchors", row, Marker.SPHERE, frame, stamp_ns, _colour(None))
        ball.pose, ball.scale = pose, Vector3(x=size, y=size, z=size)
        # RViz does not draw this text; programs read the id of the anchor from it.
        ball.text = str(anchor.id)
        text = _marker("names", row, Marker.TEXT_VIEW_FACING, frame, stamp_ns, _colour(None))
        x, y, z = anchor.position
        text.pose = Pose(position=_point((x, y, z + 0.3)), orientation=Quaternion(w=1.0))
        text.scale, text.text = Vector3(z=0.25), str(anchor)
        markers += [ball, text]
    return markers


def tag_markers(
    picture: TagPicture, received: list[int], anchors: AnchorMap, frame: str, number: int, stamp_ns: int
) -> list[Any]:
    """Return position, name, rays to the received anchors with statuses, 95 % ellipse and track."""
    estimate = picture.estimate
    if estimate is None:
        return []

    def marker(namespace: str, kind: int, colour: ColorRGBA) -> Any:
        return _marker(namespace, number, kind, frame, stamp_ns, colour)

    rays = marker("rays", Marker.LINE_LIST, _colour(palette.GREY))
    rays.scale.x = 0.02
    symbols = marker("statuses", Marker.TRIANGLE_LIST, _colour(palette.GREY))
    symbols.scale = Vector3(x=1.0, y=1.0, z=1.0)
    x, y, z = estimate.position.tolist()
    tag_point = _point((x, y, z))
    for row in received:
        if (status := picture.statuses.get(row)) is None:
            continue
        look, anchor = STATUS_LOOKS[status], anchors.anchors[row].position
        rays.points += [_point(anchor), tag_point]
        rays.colors += [_colour(look.colour)] * 2
        middle = ((anchor[0] + x) / 2, (anchor[1] + y) / 2, (anchor[2] + z) / 2)
        symbols.points += [
            _point((middle[0] + SYMBOL_M * u, middle[1] + SYMBOL_M * v, middle[2])) for u, v in look.triangles
        ]
        symbols.colors += [_colour(look.colour)] * len(look.triangles)
    if not symbols.points:
        # RViz reports a list without triangles as an error.
        symbols.action = Marker.DELETE
    tag = marker("tags", Marker.SPHERE, _colour(palette.BLUE))
    tag.pose.position, tag.scale = tag_point, Vector3(x=0.2, y=0.2, z=0.2)
    name = marker("tag_names", Marker.TEXT_VIEW_FACING, _colour(None))
    name.pose.position = _point((x, y, z + 0.3))
    name.scale, name.text = Vector3(z=0.25), picture.name
    major, minor, angle = horizontal_ellipse(estimate.covariance)
    ellipse = marker("ellipses", Marker.CYLINDER, _colour(palette.BLUE, 0.3))
    rotation = Quaternion(z=math.sin(angle / 2), w=math.cos(angle / 2))
    ellipse.pose = Pose(position=tag_point, orientation=rotation)
    ellipse.scale = Vector3(x=2.0 * major, y=2.0 * minor, z=0.02)
    trail = marker("trails", Marker.LINE_STRIP, _colour(palette.BLUE))
    trail.scale.x = 0.03
    trail.points = [_point(position) for position in picture.trail]
    return [rays, symbols, tag, name, ellipse, trail]


def _marker(namespace: str, number: int, kind: int, frame: str, stamp_ns: int, colour: ColorRGBA) -> Any:
    return Marker(
        header=endpoints.header(stamp_ns, frame),
        ns=namespace,
        id=number,
        type=kind,
        action=Marker.ADD,
        pose=Pose(orientation=Quaternion(w=1.0)),
        color=colour,
    )


def _point(position: Any) -> Point:
    x, y, z = position
    return Point(x=float(x), y=float(y), z=float(z))
