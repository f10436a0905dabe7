"""Publishers and subscriptions with their quality of service (REP-2003).

History, depth and reliability can be overridden by the standard parameters `qos_overrides.TOPIC.publisher.POLICY` and
`qos_overrides.TOPIC.subscription.POLICY`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import chain
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from std_msgs.msg import Header

from uwb_mitigation.errors import MissingDependencyError, ParameterError
from uwb_mitigation.types.stamps import NS_PER_S

DEPTH = 1000
"""Queue depth: a subscriber that stalls for 1 s at 1 kHz loses no range."""

# The other policies are ROS's defaults: reliable, volatile, keep last.
RANGES = QoSProfile(depth=DEPTH)

BATCH = 64
"""Maximum number of queued messages that one callback gets: correcting them together takes a fifth of the time."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS of messages that late-joining subscribers need too."""


def message_type(name: str) -> type:
    """Return the class of a message type such as `sensor_msgs/msg/Range`.

    Raises:
        ParameterError: The name has another form.
        MissingDependencyError: The package is not installed, or has no such message.
    """
    package, _, kind = name.replace("/msg/", "/").partition("/")
    if not (package.isidentifier() and kind.isidentifier()):
        raise ParameterError(f"type = {name!r:.60}", valid="PACKAGE/msg/NAME, such as sensor_msgs/msg/Range")
    try:
        message_class: type = getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError) as error:
        raise MissingDependencyError(
            f"the message type {name} is not installed", valid=f"install {package}, and source its workspace"
        ) from error
    return message_class


def create_publisher(node: LifecycleNode, kind: type, topic: str) -> Publisher:
    """Return a lifecycle publisher of ranges.

    Raises:
        ParameterError: an overridden quality of service is invalid, or the node publishes this topic.
    """
    with _translate_errors(node, topic):
        # rclpy writes overrides into the given profile, so each publisher needs a copy.
        qos, overriding = QoSProfile(depth=DEPTH), QoSOverridingOptions.with_default_policies()
        return node.create_lifecycle_publisher(kind, topic, qos, qos_overriding_options=overriding)


def create_subscription(
    node: LifecycleNode,
    kind: type,
    topic: str,
    callback: Callable[[Any], None],
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    **options: Any,
) -> Subscription:
    """Return a subscription; a best-effort one also receives from best-effort publishers, such as odometry.

    Raises:
        ParameterError: an overridden quality of service is invalid, or the node publishes this topic.
    """
    overriding = QoSOverridingOptions.with_default_policies()
    qos = QoSProfile(depth=DEPTH, reliability=reliability)
    with _translate_errors(node, topic):
        return node.create_subscription(
            kind, topic, callback, qos, qos_overriding_options=overriding, **options
        )


def create_raw_subscription(
    node: LifecycleNode,
    kind: type,
    topic: str,
    callback: Callable[[Iterator[tuple[bytes, int]]], None],
    on_lost: Callable[[Any], None],
) -> Subscription:
    """Return a subscription of serialised ranges.

    `callback` gets the bytes and the publisher's sequence number of at most `BATCH` queued messages. The executor then
    finds the queue empty.

    Raises:
        ParameterError: an overridden quality of service is invalid, or the node publishes this topic.
    """
    events = SubscriptionEventCallbacks(message_lost=on_lost)
    take = _RawCallback(callback)
    take.subscription = create_subscription(node, kind, topic, take, raw=True, event_callbacks=events)
    return take.subscription


class _RawCallback:
    """Passes a message, and those that wait in the queue of the subscription, to a callback.

    rclpy passes the info only to callbacks whose signature requires two arguments, but its events executor then passes
    (data, info) as one tuple.
    """

    __signature__ = inspect.signature(lambda data, info: None)

    subscription: Subscription

    def __init__(self, callback: Callable[[Iterator[tuple[bytes, int]]], None]) -> None:
        self._callback = callback

    def __call__(self, *arguments: Any) -> None:
        data, info = arguments if len(arguments) == 2 else arguments[0]
        first = data, info["publication_sequence_number"]
        self._callback(chain([first], take_queued(self.subscription, BATCH - 1)))


def take_queued(subscription: Subscription, limit: int) -> Iterator[tuple[bytes, int]]:
    """Yield messages that wait in the queue of a raw subscription, with the publisher's sequence number.

    Args:
        subscription: of serialised messages.
        limit: maximum number of messages, since more may arrive during processing.
    """
    take, kind = subscription.handle.take_message, subscription.msg_type
    for _ in range(limit):
        if (message := take(kind, True)) is None:
            return
        data, info = message
        yield data, info["publication_sequence_number"]


def incompatible_publishers(node: LifecycleNode) -> list[str]:
    """Return a warning for each best-effort publisher from which a reliable subscription of the node receives nothing."""
    return [
        f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name} publishes with best-effort reliability "
        f"and is not received: set "
        f"qos_overrides.{subscription.topic_name}.subscription.reliability:=best_effort"
        for subscription in node.subscriptions
        if subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        for endpoint in node.get_publishers_info_by_topic(subscription.topic_name)
        if endpoint.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    ]


def header(stamp_ns: int, frame_id: str) -> Header:
    """Return a message header."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


@contextmanager
def _translate_errors(node: LifecycleNode, topic: str) -> Iterator[None]:
    # rclpy raises various exception types for invalid overrides.
    try:
        yield
    except (RuntimeError, ValueError, TypeError, AttributeError, AssertionError, ParameterException) as error:
        name = node.resolve_topic_name(topic)
        prefix = f"qos_overrides.{name}."
        if not any(given.startswith(prefix) for given in getattr(node, "given_parameters", ())):
            published = node.get_publisher_names_and_types_by_node(node.get_name(), node.get_namespace())
            if name in dict(published):
                raise ParameterError(
                    f"this node uses {name} twice", valid="two topics: see the remappings"
                ) from error
            # An error of ROS, which may be transient.
            raise
        raise ParameterError(
            f"qos_overrides of {name}: {error}",
            valid="history keep_last or keep_all, depth a whole number, reliability reliable or best_effort",
        ) from error
