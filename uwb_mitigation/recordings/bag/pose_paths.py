"""Poses of a robot's own localisation: positions and orientations from a topic of a bag.

Messages are decoded with the types that the bag itself declares, so that no interface package is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from uwb_mitigation.errors import RecordingError, did_you_mean
from uwb_mitigation.recordings.bag.foreign_messages import BagTypes
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import decode_frame_id
from uwb_mitigation.types.ros.poses import POSITION_TYPES, UNOBSERVED, tag_of_frame
from uwb_mitigation.types.stamps import to_ns
from uwb_mitigation.types.tracks import Heights, PosePath, TruePath

MAX_POSES = 2_000_000
MOVES_M = 0.05
"""If an antenna's position in the robot's frame changes more, it has no constant lever arm."""

HEIGHT_TYPES = (topics.RANGE_SENSOR_TYPE, topics.ODOMETRY_TYPE, topics.POSE_TYPE)
_READABLE_TYPES = tuple(dict.fromkeys((*POSITION_TYPES, topics.TF_TYPE, *HEIGHT_TYPES, topics.IMU_TYPE)))
_MAX_FRAMES = 64
_Row = tuple[int, float, float, float, float, float, float, float]


def read_truth(path: Path, topic: str = topics.ODOMETRY_TRUTH) -> dict[int | None, TruePath]:
    """Return the positions of tags on a topic, {tag id: path}; None: another frame. Empty if the topic is missing.

    Raises:
        RecordingError: the bag cannot be read, or the topic has another type.
    """
    bag = BagReader(path)
    if topic not in bag.topics:
        return {}
    check_topic(path, bag.topics, topic, POSITION_TYPES)
    where = f"{path}, topic {topic}"
    rows: dict[int | None, dict[int, tuple[float, ...]]] = {}
    for decoded in decode_messages(bag, [topic], where):
        position, q = _pose_of(decoded)
        # An unknown heading has a very large variance, or a type without variances.
        is_known = getattr(decoded.pose, "covariance", (math.inf,) * 36)[35] < UNOBSERVED
        row = position.x, position.y, position.z, 2.0 * math.atan2(q.z, q.w) if is_known else math.nan
        tag = tag_of_frame(getattr(decoded, "child_frame_id", ""))
        if all(map(math.isfinite, row[:3])) and (tag in rows or len(rows) < _MAX_FRAMES):
            rows.setdefault(tag, {}).setdefault(to_ns(decoded.header.stamp), row)
    columns = {tag: sorted_rows(poses) for tag, poses in rows.items()}
    return {
        tag: TruePath(stamp_ns, values[:, :3], values[:, 3]) for tag, (stamp_ns, values) in columns.items()
    }


def sorted_rows(rows: Mapping[int, Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps int64 (n,) and values float64 (n, k), in the order of time, of {stamp: k values}."""
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp] for stamp in stamps], np.float64)


def read_bodies(path: Path, topic: str, frames: tuple[str, str] | None = None) -> dict[str, PosePath]:
    """Return the poses of each child frame on a topic, in the anchors' frame.

    Args:
        path: the bag.
        topic: of `POSITION_TYPES`, or /tf.
        frames: the anchors' frame and the robot's, such as map and base_link. Needed for /tf.

    Returns:
        {child frame: poses}; the key is empty for a type without a child frame.

    Raises:
        RecordingError: the bag cannot be read, has no such topic or frame, or its messages cannot be used.
    """
    bag = BagReader(path)
    where = f"{path}, topic {topic}"
    check_topic(path, bag.topics, topic, (*POSITION_TYPES, topics.TF_TYPE))
    if bag.topics[topic] == topics.TF_TYPE:
        if frames is None:
            raise RecordingError(
                "transforms between many frames", where=where, valid="--frames MAP BASE_LINK"
            )
        edges = _edges(bag, [topic, topics.TF_STATIC], where)
        return {_frame(frames[1]): _composed(edges, _frame(frames[0]), _frame(frames[1]), where)}
    bodies = _bodies(bag, topic, where)
    if frames is None or not set(bodies) - {""}:
        return bodies
    if (frame := _frame(frames[1])) not in bodies:
        raise RecordingError(
            f"no poses of {frame}",
            where=where,
            valid=f"--frames of: {', '.join(sorted(bodies))}",
            suggestion=did_you_mean(frame, bodies),
        )
    return {frame: bodies[frame]}


def _bodies(bag: BagReader, topic: str, where: str) -> dict[str, PosePath]:
    """Return {child frame: poses}."""
    rows: dict[str, list[_Row]] = {}
    for decoded in decode_messages(bag, [topic], where):
        row = _row(decoded.header.stamp, *_pose_of(decoded))
        child = _frame(getattr(decoded, "child_frame_id", ""))
        if row is not None and (child in rows or len(rows) < _MAX_FRAMES):
            rows.setdefault(child, []).append(row)
    return {child: _path(poses, where) for child, poses in (rows or {"": []}).items()}


def _pose_of(decoded: Any) -> tuple[Any, Any]:
    """Return position and orientation of a message of `POSITION_TYPES`."""
    pose = decoded.pose if hasattr(decoded.pose, "position") else decoded.pose.pose
    return pose.position, pose.orientation


def read_lever_arm(path: Path, base: str, frame: str) -> tuple[float, float, float] | None:
    """Return the pose of a frame in the robot's frame, from /tf_static and /tf; None: no such transforms.

    Raises:
        RecordingError: the frame moves relative to the robot.
    """
    bag = BagReader(path)
    names = [name for name in (topics.TF, topics.TF_STATIC) if bag.topics.get(name) == topics.TF_TYPE]
    where = f"{path}, {' and '.join(names)}"
    if not names or not frame or _frame(frame) == _frame(base):
        return None
    try:
        position = _composed(_edges(bag, names, where), _frame(base), _frame(frame), where).position
    except RecordingError:
        return None
    if float(np.ptp(position, axis=0).max()) > MOVES_M:
        raise RecordingError(f"{frame} moves relative to {base}", where=where, valid="--lever-arm X,Y,Z")
    x, y, z = np.median(position, axis=0).tolist()
    return x, y, z


def read_range_frame(path: Path) -> str:
    """Return the frame of the first range of a bag; empty: none.

    Raises:
        RecordingError: the bag or the message cannot be read.
    """
    for message in BagReader(path).messages((topics.RANGE_RAW, topics.RANGE_CORRECTED)):
        return decode_frame_id(message.data)
    return ""


def _edges(bag: BagReader, names: list[str], where: str) -> dict[str, dict[str, list[_Row]]]:
    """Return {child frame: {parent frame: transforms}}."""
    edges: dict[str, dict[str, list[_Row]]] = {}
    for decoded in decode_messages(bag, names, where):
        for transform in decoded.transforms:
            row = _row(transform.header.stamp, transform.transform.translation, transform.transform.rotation)
            child = _frame(transform.child_frame_id)
            if row is not None and (child in edges or len(edges) < _MAX_FRAMES):
                edges.setdefault(child, {}).setdefault(_frame(transform.header.frame_id), []).append(row)
    return edges


def read_heights(path: Path, topic: str, sd_m: float = 0.1) -> Heights:
    """Read a tag's height from a topic of one of the `HEIGHT_TYPES`.

    A `sensor_msgs/Range` is the height above z = 0; of the other types the z coordinate counts.

    Args:
        path: The bag.
        topic: The topic.
        sd_m: Standard deviation where the message has no variance.

    Raises:
        RecordingError: The bag cannot be read, has no such topic, or the topic contains no valid height.
    """
    rows: dict[int, tuple[float, float]] = {}
    for decoded in read_topic(path, topic, HEIGHT_TYPES):
        if hasattr(decoded, "min_range"):
            height, variance = float(decoded.range), float(getattr(decoded, "variance", 0.0))
            valid = decoded.min_range <= height <= decoded.max_range
        else:
            height, variance = float(decoded.pose.pose.position.z), float(decoded.pose.covariance[14])
            valid = True
        if valid and math.isfinite(height):
            has_variance = math.isfinite(variance) and variance > 0.0
            rows[to_ns(decoded.header.stamp)] = height, variance if has_variance else sd_m**2
    if not rows:
        where, valid = f"{path}, topic {topic}", "finite heights within the sensor's range"
        raise RecordingError("no valid height", where=where, valid=valid)
    stamp_ns, values = sorted_rows(rows)
    return Heights(stamp_ns, *values.T)


def check_topic(path: Path, recorded: dict[str, str], topic: str, types: tuple[str, ...]) -> None:
    """Raise RecordingError unless the topic exists and has one of the types."""
    if recorded.get(topic) in types:
        return
    usable = [f"{name} ({kind})" for name, kind in sorted(recorded.items()) if kind in types]
    what = f"topic {topic} has the type {recorded[topic]}" if topic in recorded else f"no topic {topic}"
    valid = ", ".join(usable) or f"a topic of type {', '.join(types)}; the bag has none"
    suggestion = did_you_mean(topic, [name for name, kind in recorded.items() if kind in types])
    raise RecordingError(what, where=path, valid=valid, suggestion=suggestion)


def read_topic(path: Path, topic: str, types: tuple[str, ...]) -> Iterator[Any]:
    """Return the messages of a topic that has one of the types.

    Raises:
        RecordingError: the bag cannot be read, has no such topic, or its messages cannot be decoded.
    """
    bag = BagReader(path)
    check_topic(path, bag.topics, topic, types)
    return decode_messages(bag, [topic], f"{path}, topic {topic}")


def decode_messages(bag: BagReader, names: list[str], where: str) -> Iterator[Any]:
    """Decode the messages of topics by the schemas of their channels."""
    types = BagTypes()
    for count, message in enumerate(bag.messages(names)):
        if count >= MAX_POSES:
            raise RecordingError(f"more than {MAX_POSES} messages", where=where, valid="a shorter recording")
        schema = message.channel.schema
        if schema is None or schema.name not in _READABLE_TYPES:
            what = f"messages of type {schema.name if schema else ''!r}"
            raise RecordingError(what, where=where, valid=", ".join(_READABLE_TYPES))
        try:
            decoded = types.decode(schema.name, schema.data, message.data)
        except Exception as error:  # Of no common type.
            raise RecordingError(f"a message or its type is damaged: {error}", where=where) from error
        yield decoded


def _frame(name: str) -> str:
    """Return the frame without the leading slash of ROS 1."""
    return name.removeprefix("/")


def _row(stamp: Any, position: Any, orientation: Any) -> _Row | None:
    """Return a pose with a unit quaternion; None: the numbers are not valid."""
    turn = (orientation.x, orientation.y, orientation.z, orientation.w)
    row = (to_ns(stamp), position.x, position.y, position.z, *turn)
    length = math.hypot(*turn)
    if not all(map(math.isfinite, row)) or not 0.5 < length < 2.0:
        return None
    x, y, z, w = (value / length for value in turn)
    return row[0], row[1], row[2], row[3], x, y, z, w


def _path(rows: list[_Row], where: str, needed: int = 2) -> PosePath:
    rows = sorted(set(rows))
    stamps = np.array([row[0] for row in rows], np.int64)
    _, first = np.unique(stamps, return_index=True)
    if len(first) < needed:
        raise RecordingError(
            f"{len(first)} poses", where=where, valid="two or more with a position and orientation"
        )
    values = np.array([row[1:] for row in rows], np.float64)[first]
    return PosePath(stamps[first], values[:, :3], values[:, 3:])


def _composed(edges: dict[str, dict[str, list[_Row]]], root: str, leaf: str, where: str) -> PosePath:
    """Return the composed transforms from the root's frame to the leaf's, at the times of the most frequent one."""
    chain: list[PosePath] = []
    frame = leaf
    while frame != root:
        if frame not in edges or len(chain) > len(edges):
            names = ", ".join(sorted({*edges, *(parent for parents in edges.values() for parent in parents)}))
            raise RecordingError(
                f"no transforms from {root} to {leaf}",
                where=where,
                valid=f"--frames of: {names or 'no frames found'}",
            )
        frame, rows = max(edges[frame].items(), key=lambda edge: len(edge[1]))
        chain.append(_path(rows, where, 1))
    if not chain:
        raise RecordingError(f"--frames {root} {leaf}", where=where, valid="two different frames")
    stamps = max(chain, key=len).stamp_ns
    position, turn = np.zeros((len(stamps), 3)), Rotation.identity(len(stamps))
    for step in reversed(chain):
        moved, turned = step.interpolated(stamps)
        position, turn = position + turn.apply(moved), turn * turned
    return PosePath(stamps, position, turn.as_quat())
