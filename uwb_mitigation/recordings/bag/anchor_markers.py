"""Anchors as markers in a bag, so that they stay with the recording."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_mitigation.errors import RecordingError, UwbMitigationError
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.anchors import MAX_ANCHORS, Anchor, AnchorMap, anchors_path, load_anchors
from uwb_mitigation.types.ros import schemas
from uwb_mitigation.types.ros.poses import MAP, header_fields, quaternion, vector
from uwb_mitigation.types.ros.topics import ANCHORS, MARKERS_TYPE

if TYPE_CHECKING:
    from uwb_mitigation.recordings.bag.writer import BagWriter

MAX_NAME = 100
SPHERE = 2
"""Type of a marker."""


def parse_markers(message: Any) -> Iterator[Anchor]:
    """Yield the anchors of a visualization_msgs/MarkerArray; implausible markers are skipped.

    A marker of the namespace `anchors` has the id of the anchor as its text, that of `names` with the same number its label.
    """
    labels = {marker.id: str(marker.text) for marker in message.markers if marker.ns == "names"}
    for marker in message.markers:
        point, text = marker.pose.position, marker.text
        if marker.ns != "anchors" or not math.isfinite(point.x + point.y):
            continue
        if text.isascii() and text.isdigit() and len(text) <= 20 and int(text) < 1 << 64:
            name = labels.get(marker.id, "").partition(" (")[2].removesuffix(")")[:MAX_NAME]
            yield Anchor(int(text), (point.x, point.y, point.z), name=name)


def recorded_anchors(bag: Path) -> AnchorMap | None:
    """Return the anchors of a bag's anchors file, else of the first markers in the bag; None: there are none.

    Raises:
        ParameterError: the anchors file is invalid.
    """
    if (file := anchors_path(bag)).is_file():
        return load_anchors(file)
    with contextlib.suppress(RecordingError):
        for message in BagReader(bag).messages([ANCHORS]):
            with contextlib.suppress(UwbMitigationError):
                parsed = parse_markers(schemas.deserialize(MARKERS_TYPE, message.data))
                anchors = {anchor.id: anchor for anchor in parsed if math.isfinite(anchor.position[2])}
                if anchors:
                    return AnchorMap([*anchors.values()][:MAX_ANCHORS], str(bag))
    return None


def read_anchors(bag: Path, file: Path | None = None) -> AnchorMap:
    """Return the anchors of a file, else those of the bag.

    Raises:
        ParameterError: there are none.
    """
    return (None if file else recorded_anchors(bag)) or load_anchors(file or anchors_path(bag))


def write_anchors(bag: BagWriter, anchors: AnchorMap, stamp_ns: int) -> None:
    """Write the anchors as one MarkerArray.

    Raises:
        RecordingError: the bag cannot be written.
    """
    header, no_bytes = header_fields(stamp_ns, MAP), np.zeros(0, np.uint8)

    def marker(row: int, namespace: str, text: str) -> Fields:
        position = vector(*anchors.anchors[row].position)
        return Fields(
            header=header, ns=namespace, id=row, type=SPHERE, action=0, scale=vector(0.2, 0.2, 0.2), text=text,
            pose=Fields(position=position, orientation=quaternion(0.0)), color=Fields(r=0.0, g=0.0, b=0.0, a=1.0),
            lifetime=Fields(sec=0, nanosec=0), frame_locked=False, points=[], colors=[], texture_resource="",
            texture=Fields(header=header, format="", data=no_bytes), uv_coordinates=[], mesh_resource="",
            mesh_file=Fields(filename="", data=no_bytes), mesh_use_embedded_materials=False,
        )  # fmt: skip

    rows = range(len(anchors))
    markers = [marker(row, "anchors", str(anchors.anchors[row].id)) for row in rows]
    markers += [marker(row, "names", str(anchors.anchors[row])) for row in rows]
    bag.write_message(ANCHORS, MARKERS_TYPE, schemas.serialize(MARKERS_TYPE, markers=markers), stamp_ns)
