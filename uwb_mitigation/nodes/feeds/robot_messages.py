"""Odometry, IMU and transforms of a recorded robot, which a replay publishes with the ranges."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.time import Time

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.ros.poses import MAP
from uwb_mitigation.types.ros.topics import IMU_TYPE, ODOMETRY_TYPE, TF_STATIC, TF_TYPE, relative
from uwb_mitigation.types.stamps import NS_PER_S, to_ns

_TYPES = (ODOMETRY_TYPE, IMU_TYPE, TF_TYPE)
_QOS = QoSProfile(depth=100)
_MAX_DELAY_NS = NS_PER_S
"""A message that was received later than this after its stamp is due when it was received."""


class RobotMessage(NamedTuple):
    """A recorded message, and the time in the recording at which it is due."""

    recorded_ns: int
    topic: str
    message: Any


class RobotMessages:
    """Reads the topics of a robot from a bag, and publishes their messages with new stamps.

    Iterating yields the messages in the order of reception. Transforms from the map are left out, because the locator of
    the replay publishes them.

    Args:
        node: the driver; the publishers exist until its `close`. Its parameter `path` is the bag. Names in `robot_topics` that
            the bag does not contain, or with another type, are ignored.

    Raises:
        RecordingError: the bag cannot be read.
        MissingDependencyError: a message type is not installed.
    """

    def __init__(self, node: ManagedNode) -> None:
        self._path, self._node = Path(node.value("path")).expanduser(), node
        recorded, names = BagReader(self._path).topics, node.value("robot_topics").replace(" ", "").split(",")
        self._types = {
            name: endpoints.message_type(recorded[name]) for name in names if recorded.get(name) in _TYPES
        }
        self._publishers = {name: self._create_publisher(name) for name in self._types}

    @property
    def topics(self) -> list[str]:
        """The topics that the bag contains."""
        return list(self._types)

    def publish_static(self) -> None:
        """Publish the static transforms of the whole recording in one message, for late subscribers, too."""
        if TF_STATIC not in self._types:
            return
        transforms: dict[str, Any] = {}
        for _, _, message in self._messages([TF_STATIC]):
            transforms |= {transform.child_frame_id: transform for transform in message.transforms}
        self._publishers[TF_STATIC].publish(self._types[TF_STATIC](transforms=list(transforms.values())))

    def __iter__(self) -> Iterator[RobotMessage]:
        return self._messages([name for name in self._types if name != TF_STATIC])

    def publish(self, item: RobotMessage, shift_ns: int) -> None:
        """Publish a message; `shift_ns` is added to its stamps."""
        for stamped in _stamped(item.message):
            stamped.header.stamp = Time(nanoseconds=max(to_ns(stamped.header.stamp) + shift_ns, 0)).to_msg()
        self._publishers[item.topic].publish(item.message)

    def _create_publisher(self, name: str) -> Publisher:
        qos = endpoints.LATCHED if name == TF_STATIC else _QOS
        publisher = self._node.create_publisher(self._types[name], relative(name), qos)
        return self._node.destroy_at_close(publisher, self._node.destroy_publisher)

    def _messages(self, names: list[str]) -> Iterator[RobotMessage]:
        try:
            for raw in BagReader(self._path).messages(names) if names else ():
                name = raw.channel.topic
                try:
                    message = deserialize_message(raw.data, self._types[name])
                except Exception as error:  # rclpy raises various types, and no message may end the replay.
                    text = f"a message of {name} cannot be read: {error}"
                    self._node.get_logger().warning(text, throttle_duration_sec=10.0)
                    continue
                if hasattr(message, "transforms"):
                    message.transforms = [t for t in message.transforms if t.header.frame_id != MAP]
                if not (stamped := _stamped(message)):
                    continue
                delay_ns = raw.log_time_ns - to_ns(stamped[0].header.stamp)
                due_ns = raw.log_time_ns - (delay_ns if 0 <= delay_ns <= _MAX_DELAY_NS else 0)
                yield RobotMessage(due_ns, name, message)
        except RecordingError:
            # The ranges come from the same file and report it.
            return


def _stamped(message: Any) -> list[Any]:
    """Return the parts of a message that have a header."""
    return list(message.transforms) if hasattr(message, "transforms") else [message]
