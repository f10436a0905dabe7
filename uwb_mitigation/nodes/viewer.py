"""The node `viewer`: shows the topics on a page in the browser.

It publishes only diagnostics and, with an anchors file, the markers of the anchors.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth
from visualization_msgs.msg import MarkerArray

from uwb_mitigation.nodes import markers
from uwb_mitigation.nodes.feeds.replay_clock import ReplayClock
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.types.anchors import AnchorMap, load_anchors
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.topics import relative
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.scene import DEFAULT_TAG, MAX_TAGS, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

# Best effort: a publisher must not wait for a display.
_QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)

MAX_BATCH = 500
"""Maximum number of ranges of a topic that are read at once, so that pages are served while many wait."""

DISCOVERY_PERIOD_S = 0.5
"""Interval of the search for new topics."""

READ_PERIOD_S = 0.1
"""Interval at which the queued ranges are read; a queue holds those of 5 s at 1000 ranges per second."""


class Viewer(ManagedNode):
    """Lifecycle: configure subscribes, activate serves the page, deactivate ends it."""

    def __init__(self) -> None:
        super().__init__("viewer")
        self._subscribed: dict[str, Subscription] = {}
        self._range_node: Node | None = None
        self._ranges: dict[str, Subscription] = {}
        self._last_sequence, self._has_single_publisher = 0, False
        self._anchors: AnchorMap | None = None
        self._anchors_out: Publisher | None = None
        self._server: ViewerServer | None = None
        self._scene = Scene()
        self._feed = SceneUpdater(self._scene)
        pace = ReplayClock(self.get_clock())
        self._scene.clock = lambda: pace.now_ns() / NS_PER_S
        self._scene.stamp_clock = lambda: self.now_ns() / NS_PER_S
        self._view: View | None = None
        self.autostart()

    def open(self) -> None:
        if path := self.value("anchors"):
            self._anchors = load_anchors(Path(path).expanduser())
            self._scene.set_anchors(self._anchors.anchors)
            self._anchors_out = self.publisher(MarkerArray, topics.ANCHORS, endpoints.LATCHED)
        else:
            self._subscribe(MarkerArray, relative(topics.ANCHORS), topics.ANCHORS, qos=endpoints.LATCHED)
        self._subscribe(DiagnosticArray, topics.DIAGNOSTICS, topics.DIAGNOSTICS)
        self._subscribe(PoseWithCovarianceStamped, relative(topics.POSE), topics.POSE)
        self._subscribe(Odometry, relative(topics.ODOMETRY_TRUTH), topics.ODOMETRY_TRUTH)
        # No executor spins this node: waking up for every range would take CPU time from the mitigator.
        range_node = Node(
            f"_{self.get_name()}_ranges",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._range_node = self.destroy_at_close(range_node, lambda node: node.destroy_node())
        self._subscribe_ranges(RangeTruth, topics.RANGE_TRUTH)
        self._subscribe_ranges(RangeCorrected, topics.RANGE_CORRECTED)
        self.steady_timer(DISCOVERY_PERIOD_S, self._discover_topics)
        self.steady_timer(READ_PERIOD_S, self._read_queued_ranges)

    def begin(self) -> None:
        self._view = View(
            self._scene,
            title=f"UWB ranges {self.get_namespace().strip('/')}".strip(),
            window=self.value("window"),
        )
        origins = tuple(origin.strip() for origin in self.value("origins").split(",") if origin.strip())
        host, port, token = (self.value(name) for name in ("host", "port", "token"))
        self._server = ViewerServer(self._view, host, port, origins, token)
        if self._server.warning:
            self.get_logger().warning(f"{self._server.warning} (parameter token)")
        if self._anchors is not None and self._anchors_out is not None:
            shown = markers.anchor_markers(self._anchors, self.value("map_frame"), self.now_ns())
            self._anchors_out.publish(MarkerArray(markers=shown))
        self.get_logger().info(f"the page is at {self._server.url}")

    def end(self) -> None:
        if self._server is not None:
            self._server.close()
        self._server = self._view = None

    def close(self) -> None:
        super().close()
        self._subscribed, self._ranges, self._anchors_out, self._range_node = {}, {}, None, None

    def describe(self) -> diagnostics.Description:
        pages = 0 if self._view is None else self._view.pages
        url = "" if self._server is None else self._server.url
        values: dict[str, object] = {"url": url, "pages": pages, "malformed": self._feed.malformed}
        values["dropped"] = self._scene.dropped
        return url, diagnostics.OK, f"serving {pages} page{'' if pages == 1 else 's'}", values

    def _subscribe(
        self, kind: type, topic: str, plain: str, tag: str = DEFAULT_TAG, qos: QoSProfile = _QOS
    ) -> None:
        """Subscribe to a topic; `plain` is its name in a bag."""
        if topic not in self._subscribed:
            callback = partial(self._feed.add, plain, tag=tag)
            self._subscribed[topic] = self.subscription(kind, topic, callback, qos)

    def _subscribe_ranges(self, kind: type, topic: str) -> None:
        """Subscribe to a topic of ranges; they are queued until `_read_queued_ranges`."""
        if self._range_node is not None and topic not in self._ranges:
            # Resolve with the remapping arguments of this node.
            name = self.resolve_topic_name(relative(topic))
            self._ranges[topic] = self._range_node.create_subscription(
                kind, name, lambda _: None, _QOS, raw=True
            )

    def _read_queued_ranges(self) -> None:
        # A truth is published before its corrected range: reading truths last and adding them first misses none.
        corrected, truths, raw = (
            list(endpoints.take_queued(self._ranges[topic], MAX_BATCH)) if topic in self._ranges else []
            for topic in (topics.RANGE_CORRECTED, topics.RANGE_TRUTH, topics.RANGE_RAW)
        )
        for topic, queued in ((topics.RANGE_TRUTH, truths), (topics.RANGE_RAW, raw)):
            for data, _ in queued:
                self._feed.add_encoded(topic, data)
        for data, number in corrected:
            # The gaps are messages that did not reach the viewer: their ranges are not lost by the radio.
            dropped = number - self._last_sequence - 1 if self._last_sequence else 0
            self._last_sequence = number
            if dropped > 0 and self._has_single_publisher:
                with self._scene.lock:
                    self._scene.count_dropped(dropped)
            self._feed.add_encoded(topics.RANGE_CORRECTED, data)

    def _discover_topics(self) -> None:
        """Subscribe to topics that have become available or necessary."""
        # Publishers count their messages separately.
        self._has_single_publisher = (
            self.count_publishers(self.resolve_topic_name(topics.RANGE_CORRECTED)) == 1
        )
        if self._view is not None:
            self._scene.missing = self._missing()
        # Subscribe to CIRs on demand: they are most of the traffic, and a pipeline publishes them only if subscribed.
        if self._view is not None and self._view.pages:
            self._subscribe_ranges(RangeCir, topics.RANGE_RAW)
        elif self._range_node is not None and topics.RANGE_RAW in self._ranges:
            self._range_node.destroy_subscription(self._ranges.pop(topics.RANGE_RAW))
        # The locator publishes every further tag on a separate topic; a remapping of the plain topic does not apply to it.
        head, _, tail = self.resolve_topic_name(relative(topics.POSE), only_expand=True).rpartition("/")
        tag_topic = re.compile(rf"{re.escape(head)}/(tag_(?:\d+|0x[0-9a-f]+))/{re.escape(tail)}")
        for topic, _ in self.get_topic_names_and_types():
            if (match := tag_topic.fullmatch(topic)) and len(self._subscribed) < MAX_TAGS:
                self._subscribe(PoseWithCovarianceStamped, topic, topics.POSE, match[1])

    def _missing(self) -> dict[str, str]:
        """Return the reasons for an empty page, such as a node that is not running."""
        raw, corrected, anchors, poses = (
            self.resolve_topic_name(relative(topic))
            for topic in (topics.RANGE_RAW, topics.RANGE_CORRECTED, topics.ANCHORS, topics.POSE)
        )
        if self.count_publishers(corrected):
            ranges = f"No ranges received: {corrected} has a publisher but no messages."
        elif self.count_publishers(raw):
            ranges = f"No ranges received: {raw} has a publisher, {corrected} has none. Start the mitigator."
        else:
            ranges = f"No ranges received: {raw} and {corrected} have no publisher. Start the driver and the mitigator."
        positions = f"No tag positions: {poses} has no publisher. Start the locator."
        if self.count_publishers(poses):
            positions = "No tag positions yet: see the diagnostics of the locator."
        no_anchors = f"No anchor positions: nothing received on {anchors}. Start the locator, or set the parameter anchors."
        return {"ranges": ranges, "anchors": no_anchors, "positions": positions}
