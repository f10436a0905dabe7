"""Topic names and qualities of service (REP-2003), and the publishers and subscriptions of ranges.

The names are relative: `/uwb/range_raw` without a namespace, `/board1/uwb/range_raw` under `board1`.
History, depth and reliability can be overridden by the standard parameters
`qos_overrides.TOPIC.publisher.POLICY` and `qos_overrides.TOPIC.subscription.POLICY`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from uwb_mitigation.errors import ParameterError

RANGE_RAW = "uwb/range_raw"
RANGE_CORRECTED = "uwb/range_corrected"
RANGE_TRUTH = "uwb/range_truth"
POSE = "uwb/pose"
ODOMETRY = "uwb/odometry"
POSE_SMOOTHED = "uwb/pose_smoothed"
ANCHORS = "uwb/anchors"
ODOMETRY_TRUTH = "uwb/odometry_truth"
TF = "/tf"
DIAGNOSTICS = "/diagnostics"
CLOCK = "/clock"

# A reader that stalls loses nothing until it is this many ranges behind: 1 s at 1 kHz.
DEPTH = 1000


def _ranges(reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> QoSProfile:
    return QoSProfile(
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
    )


RANGES = _ranges()


LATCHED = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
)
"""Of what a late subscriber wants too."""


def create_publisher(node: LifecycleNode, kind: type, topic: str) -> Publisher:
    """A lifecycle publisher of ranges.

    Raises:
        ParameterError: an overridden quality of service is none.
    """
    with _checked(node, topic):
        # rclpy writes overrides into the profile it is given: each gets one of its own.
        return node.create_lifecycle_publisher(
            kind, topic, _ranges(), qos_overriding_options=QoSOverridingOptions.with_default_policies()
        )


def create_subscription(
    node: LifecycleNode,
    kind: type,
    topic: str,
    callback: Callable[[Any], None],
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
) -> Subscription:
    """Return a subscription; a best-effort one also receives from best-effort publishers, such as odometry.

    Raises:
        ParameterError: an overridden quality of service is none.
    """
    with _checked(node, topic):
        return node.create_subscription(
            kind,
            topic,
            callback,
            _ranges(reliability),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )


def create_raw_subscription(
    node: LifecycleNode,
    kind: type,
    topic: str,
    callback: Callable[[bytes, int], None],
    on_lost: Callable[[Any], None],
) -> Subscription:
    """A subscription of ranges that hands over serialised bytes, and the number that their publisher gave them.

    Raises:
        ParameterError: an overridden quality of service is none.
    """

    def taken(*message: Any) -> None:
        # rclpy's executors pass message and info; its events executor passes both as one tuple.
        data, info = message if len(message) == 2 else message[0]
        callback(data, number_of(info))

    # By its signature rclpy tells that the info is wanted.
    vars(taken)["__signature__"] = inspect.signature(lambda data, info: None)
    with _checked(node, topic):
        return node.create_subscription(
            kind,
            topic,
            taken,
            _ranges(),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(message_lost=on_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )


def number_of(info: dict[str, int]) -> int:
    """The number of a message from its publisher, as rclpy's `take_message` has it."""
    return info["publication_sequence_number"]


def not_received(node: LifecycleNode) -> list[str]:
    """Return a line for each best-effort publisher from which a reliable subscription of the node receives nothing."""
    return [
        f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name} publishes by best effort and is not received: set "
        f"qos_overrides.{subscription.topic_name}.subscription.reliability:=best_effort"
        for subscription in node.subscriptions
        if subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        for endpoint in node.get_publishers_info_by_topic(subscription.topic_name)
        if endpoint.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    ]


@contextmanager
def _checked(node: LifecycleNode, topic: str) -> Iterator[None]:
    # rclpy raises a different type for each way of being wrong.
    try:
        yield
    except (RuntimeError, ValueError, TypeError, AttributeError, AssertionError, ParameterException) as error:
        raise ParameterError(
            f"qos_overrides of {node.resolve_topic_name(topic)}: {error}",
            valid="history keep_last or keep_all, depth a whole number, reliability reliable or best_effort",
        ) from error
