"""The node `viewer`: a page in the browser on what passes on the topics.

It subscribes, and publishes but diagnostics and, of an anchors file that it was given, the anchors' markers.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.timer import Timer
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth
from visualization_msgs.msg import MarkerArray

from uwb_mitigation.nodes import clocks, diagnostics, markers, topics
from uwb_mitigation.nodes.health import Numbering
from uwb_mitigation.nodes.lifecycle import ManagedNode
from uwb_mitigation.nodes.parameter_tables import VIEWER
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.sources.site import load_anchors
from uwb_mitigation.viewer.feed import Feed
from uwb_mitigation.viewer.scene import MAX_TAGS, PLAIN, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.view import Missing, View

OURS = ("driver", "mitigator", "locator", "viewer")
"""Nodes whose parameters are shown."""

ANSWER_S = 1.0
"""How long their answers are waited for."""

# Never reliable: a publisher must not wait for somebody who only looks.
_LOOK = QoSProfile(
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
    history=HistoryPolicy.KEEP_LAST,
    depth=200,
)
LOOK_AROUND_S = 0.5
HEAR_S = 0.1
"""From one look into the queues of ranges to the next: no page is drawn more often. Of more than `_LOOK.depth`, the last count."""


class Viewer(ManagedNode):
    """Lifecycle: configure subscribes, activate serves the page, deactivate ends it."""

    def __init__(self) -> None:
        super().__init__("viewer", VIEWER)
        self._looking: dict[str, Subscription] = {}
        self._ears: Node | None = None
        self._ranges: dict[str, Subscription] = {}
        self._numbering = Numbering(self._publisher_count)
        self._anchors: AnchorMap | None = None
        self._anchors_out: Publisher | None = None
        self._ticking: list[Timer] = []
        self._server: ViewerServer | None = None
        self._scene = Scene()
        self._lock = threading.Lock()
        self._feed = Feed(self._scene, self._lock)
        pace = clocks.Pace(self.get_clock())
        self._feed.set_clock(lambda: pace.now_ns() / 1e9)
        self._view: View | None = None
        self._asked: dict[str, AsyncParameterClient] = {}
        self.autostart()

    def open(self) -> None:
        self._numbering = Numbering(self._publisher_count)
        if path := self.value("anchors"):
            self._anchors = load_anchors(Path(path).expanduser())
            self._feed.anchors(self._anchors)
            self._anchors_out = self.create_lifecycle_publisher(MarkerArray, topics.ANCHORS, topics.LATCHED)
        else:
            self._look(MarkerArray, topics.ANCHORS, self._feed.markers, qos=topics.LATCHED)
        feed = self._feed
        self._look(DiagnosticArray, topics.DIAGNOSTICS, feed.diagnostics)
        self._look(PoseWithCovarianceStamped, topics.POSE, partial(feed.pose, PLAIN))
        self._look(Odometry, topics.ODOMETRY_TRUTH, feed.true_position)
        # Of a node that no executor spins: nobody is woken by a range, which would take time from whoever corrects it.
        self._ears = Node(
            f"_{self.get_name()}_ranges",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._listen(RangeTruth, topics.RANGE_TRUTH)
        self._listen(RangeCorrected, topics.RANGE_CORRECTED)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._ticking = [
            self.create_timer(LOOK_AROUND_S, self._look_around, clock=steady),
            self.create_timer(HEAR_S, self._hear, clock=steady),
        ]

    def _look(
        self,
        kind: type,
        topic: str,
        take: Callable[[Any], None],
        *,
        qos: QoSProfile = _LOOK,
    ) -> None:
        if topic not in self._looking:
            self._looking[topic] = self.create_subscription(kind, topic, take, qos)

    def _listen(self, kind: type, topic: str) -> None:
        """Let ranges queue up until `_hear`."""
        if self._ears is not None and topic not in self._ranges:
            # By the name that arguments may have given it: they are this node's.
            name = self.resolve_topic_name(topic)
            self._ranges[topic] = self._ears.create_subscription(kind, name, _hear_nothing, _LOOK, raw=True)

    def _hear(self) -> None:
        """Take what has queued up."""
        # A truth is sent before its corrected range: taken after it and used before, none is missed.
        corrected, truths, raw = map(
            self._queued, (topics.RANGE_CORRECTED, topics.RANGE_TRUTH, topics.RANGE_RAW)
        )
        for _, number in corrected:
            self._numbering.add(number)
        for feed, queued in (
            (self._feed.range_truth, truths),
            (self._feed.range_raw, raw),
            (self._feed.range_corrected, corrected),
        ):
            for data, _ in queued:
                feed(data)

    def _queued(self, topic: str) -> list[tuple[bytes, int]]:
        """The messages in the queue of a topic, and their publishers' numbers of them."""
        if (subscription := self._ranges.get(topic)) is None:
            return []
        take, kind = subscription.handle.take_message, subscription.msg_type
        # Never more than it holds: more may come as fast as they are taken.
        found = (take(kind, True) for _ in range(_LOOK.depth))
        return [(data, topics.number_of(info)) for data, info in takewhile(bool, found)]

    def _look_around(self) -> None:
        """Subscribe to what is wanted, or there, only by now."""
        if self._view is not None:
            self._view.missing = self._missing()
        # CIRs are most of what is sent: a pipeline sends none where nobody looks.
        if self._view is not None and self._view.drawing.pages:
            self._listen(RangeCir, topics.RANGE_RAW)
        elif self._ears is not None and topics.RANGE_RAW in self._ranges:
            self._ears.destroy_subscription(self._ranges.pop(topics.RANGE_RAW))
        # The locator gives every tag but one topics of its own, once it is heard.
        # What names the plain topic anew does not name theirs.
        plain = self.resolve_topic_name(topics.POSE, only_expand=True)
        head, _, tail = plain.rpartition("/")
        own = re.compile(rf"{re.escape(head)}/(tag_(?:\d+|0x[0-9a-f]+))/{re.escape(tail)}")
        for topic, _ in self.get_topic_names_and_types():
            if (found := own.fullmatch(topic)) and len(self._looking) < MAX_TAGS:
                self._look(PoseWithCovarianceStamped, topic, partial(self._feed.pose, found[1]))

    def _missing(self) -> Missing:
        """Return why the page is empty: which node is not running."""
        raw, corrected, anchors, poses = (
            self.resolve_topic_name(topic)
            for topic in (topics.RANGE_RAW, topics.RANGE_CORRECTED, topics.ANCHORS, topics.POSE)
        )
        if self.count_publishers(corrected):
            ranges = f"No ranges received: {corrected} has a publisher but no messages."
        elif self.count_publishers(raw):
            ranges = f"No ranges received: {raw} has a publisher, {corrected} has none. Start the mitigator."
        else:
            ranges = f"No ranges received: {raw} and {corrected} have no publisher. Start the driver and the mitigator."
        return Missing(
            ranges=ranges,
            anchors=f"No anchor positions: nothing received on {anchors}. Start the locator, or set the parameter anchors.",
            positions="No tag positions yet: see the diagnostics of the locator."
            if self.count_publishers(poses)
            else f"No tag positions: {poses} has no publisher. Start the locator.",
        )

    def begin(self) -> None:
        self._view = View(
            self._scene,
            self._lock,
            title=f"UWB ranges {self.get_namespace().strip('/')}".strip(),
            window=self.value("window"),
        )
        origins = tuple(origin.strip() for origin in self.value("origins").split(",") if origin.strip())
        self._server = ViewerServer(
            self._view, self.value("host"), self.value("port"), origins, self._parameters_of_nodes
        )
        if self._anchors is not None and self._anchors_out is not None:
            now_ns = clocks.reader(self.get_clock())()
            shown = markers.anchor_markers(self._anchors, self.value("map_frame"), now_ns)
            self._anchors_out.publish(markers.array(shown))
        self.get_logger().info(f"the page is at {self._server.url}")

    def end(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.close()
        # Its pages are gone.
        self._view = None

    def close(self) -> None:
        for timer in self._ticking:
            self.destroy_timer(timer)
        if self._ears is not None:
            self._ears.destroy_node()
        for subscription in self._looking.values():
            self.destroy_subscription(subscription)
        if self._anchors_out is not None:
            self.destroy_lifecycle_publisher(self._anchors_out)
        self._looking, self._ranges, self._ticking, self._anchors_out, self._ears = {}, {}, [], None, None

    def describe(self) -> tuple[str, bytes, str, dict[str, object]]:
        pages = 0 if self._view is None else self._view.drawing.pages
        url = "" if self._server is None else self._server.url
        passed_over = self._numbering.missing
        facts: dict[str, object] = {
            "url": url,
            "pages": pages,
            "malformed": self._feed.malformed,
            "passed over": passed_over,
        }
        text = f"serving {pages} page{'' if pages == 1 else 's'}"
        if passed_over:
            text += f"; {passed_over} ranges passed over, for they came too fast to be shown"
        return url, diagnostics.OK, text, facts

    def _publisher_count(self) -> int:
        corrected = self._ranges.get(topics.RANGE_CORRECTED)
        return 0 if corrected is None else int(corrected.get_publisher_count())

    def _parameters_of_nodes(self) -> dict[str, dict[str, object]]:
        """What our nodes in this namespace say of themselves; called from the page's thread, answered by the executor's."""
        found: dict[str, dict[str, object]] = {}
        for name, namespace in self.get_node_names_and_namespaces():
            if namespace != self.get_namespace() or name not in OURS:
                continue
            if name == self.get_name():
                found[name] = {row.name: self.value(row.name) for row in VIEWER}
                continue
            # One for each name, for good: another is not destroyed by itself.
            if name not in self._asked:
                self._asked[name] = AsyncParameterClient(self, f"{namespace.rstrip('/')}/{name}")
            client = self._asked[name]
            listed = _wait(client.list_parameters())
            if listed is None:
                continue
            names = sorted(listed.result.names)
            values = _wait(client.get_parameters(names))
            if values is not None:
                found[name] = dict(zip(names, map(parameter_value_to_python, values.values), strict=True))
        return found


def _hear_nothing(_message: object) -> None:
    """Ranges are taken, not given."""


def _wait(future: Future) -> Any:
    """The result of a call, or None where none comes; the executor of another thread completes it."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return future.result() if done.wait(ANSWER_S) else None


def make_nodes(stop: threading.Event) -> list[Node]:
    return [Viewer()]
