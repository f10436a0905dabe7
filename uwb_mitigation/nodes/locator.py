"""The node `locator`: subscribes to `/uwb/range_corrected`, publishes the positions of the tags."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected
from visualization_msgs.msg import MarkerArray

from uwb_mitigation.errors import MissingDependencyError, ParameterError, RecordingError, format_id
from uwb_mitigation.nodes import markers, robot_motion
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.nodes.support.position_monitor import PositionMonitor
from uwb_mitigation.nodes.support.respawn import StateFile
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Area, Height, parse_lever_arm
from uwb_mitigation.positioning.multi_tag import MultiTagEstimator, TagState
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning
from uwb_mitigation.types.anchors import AnchorMap, load_anchors
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.types.ros import codec, poses, topics
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heading

if TYPE_CHECKING:
    from uwb_mitigation.nodes.feeds.topic import TopicFeed
    from uwb_mitigation.recordings.mapping.mapping import Mapping

LOG_AFTER_S = 5.0
"""Warnings are in the diagnostics at once, and in the log if they last: other nodes may start later, and a search begins with some."""

PERIOD_S = 0.2
"""Period of smoothed poses, of markers, and of predictions without ranges."""

PREDICT_AFTER_S, PREDICT_UNTIL_S = 0.3, 30.0
"""A tag without ranges is predicted between these ages of its last range; later the covariance exceeds most halls."""

STALE_S = 10.0
"""After this time without ranges of a tag, the diagnostics contain only its verdict: until then, it may return."""

_REPEAT_AFTER_NS = 300_000_000
"""After this time without estimates, map to odom is repeated."""


class _Outputs:
    """The publishers of one tag, its frame, and the stamps of its last poses.

    `robot` is the estimator of the tag if a robot with odometry carries it; `number`: see `tag_topic`.
    """

    def __init__(self, node: Locator, tag: TagState, number: int | None, frame: str) -> None:
        self.pose = node.publisher(PoseWithCovarianceStamped, poses.tag_topic(topics.POSE, number))
        self.odometry = node.publisher(Odometry, poses.tag_topic(topics.ODOMETRY, number))
        self.smoothed = node.publisher(
            PoseWithCovarianceStamped, poses.tag_topic(topics.POSE_SMOOTHED, number)
        )
        self.frame = frame
        self.robot = tag.robot
        self.picture = markers.TagPicture(frame)
        self.monitor = PositionMonitor(tag)
        self.published_ns = self.smoothed_ns = -(1 << 62)


class Locator(ManagedNode):
    """Lifecycle: configure reads the anchors and creates the topics, activate starts tracking tags.

    If the anchors file is missing or invalid, the node stays unconfigured, and log and diagnostics name the reason;
    configure it again after the file is fixed.
    """

    def __init__(self) -> None:
        super().__init__("locator")
        self._estimator: MultiTagEstimator | None = None
        self._anchors_out: Publisher | None = None
        self._tf: Publisher | None = None
        self._tf_type: Any = None
        self._decode: Callable[[bytes], tuple[codec.MeasurementKey, CorrectedRange]] = codec.decode_corrected
        self._make_estimator: Callable[[AnchorMap], MultiTagEstimator]
        self._plain_tag = 0
        self._transform_ns: dict[str, int] = {}
        self._outputs: dict[int, _Outputs] = {}
        self._robot: robot_motion.OdometryInput | None = None
        self._lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._ranges_topic, self._good_s, self._has_warned = "", math.inf, False
        self._malformed = self._lost = 0
        self._unknown_anchors: set[int] = set()
        self._processing_ns: deque[int] = deque(maxlen=diagnostics.MAX_LATENCIES)
        self._meter = diagnostics.RateMonitor(self.now_ns)
        self._state_file = StateFile(self.respawn_file("state"), self.get_logger())
        # Without anchors it keeps running, so that the diagnostics name the reason.
        with contextlib.suppress(ParameterError, MissingDependencyError):
            self.autostart()

    def open(self) -> None:
        path = self.value("anchors")
        if not path:
            raise ParameterError(
                "parameter anchors is empty", valid="anchors:=FILE of {id, x, y, z}, or a topic"
            )
        range_sd = self._subscribe_to_ranges(self.value("ranges")) or self.value("range_sd")
        model = NoiseModel(acceleration=self.value("acceleration"), range_sd=range_sd)
        height = Height(self.value("height"), self.value("height_sd")) if self.value("level") else None
        area = Area.parse(self.value("area"))
        self._lever_arm = parse_lever_arm(self.value("lever_arm")) or (0.0, 0.0, 0.0)
        robot = RobotData(lever_arm=self._lever_arm) if self.value("odometry") else None
        path_of_base, self._plain_tag = DeadReckoning(), self.value("tag")

        def make_estimator(anchors: AnchorMap) -> MultiTagEstimator:
            is_verified = self._robot is not None and self._robot.state.map_to_odom is not None
            known = robot and replace(robot, is_verified=is_verified)
            config = EstimatorConfig(anchors, model, height, area, robot=known)
            return MultiTagEstimator(config, self._plain_tag, path_of_base)

        self._make_estimator = make_estimator
        self._period_ns = round(NS_PER_S / self.value("rate")) if self.value("rate") > 0 else 0
        self._offset_ns = round(self.value("stamp_offset") * NS_PER_S)
        self._map, self._plain_frame = self.value("map_frame"), self.value("tag_frame")
        frame_tag = poses.tag_of_frame(self._plain_frame)
        if frame_tag not in (None, self.value("tag")) or self._plain_frame == self._map:
            raise ParameterError(
                f"parameter tag_frame = {self._plain_frame!r} is the frame of another tag or of the map",
                valid="a name of its own, such as uwb_tag",
            )
        self._tolerance_ns = round(self.value("transform_tolerance") * NS_PER_S)
        if self.value("publish_tf"):
            self._tf_type = robot_motion.transform_type()
            if self._tf_type is None:
                raise MissingDependencyError(
                    "publish_tf needs tf2_msgs, which is not installed",
                    valid="apt install ros-jazzy-tf2-msgs, or publish_tf:=false",
                )
            self._tf = self.publisher(self._tf_type, topics.TF, QoSProfile(depth=100))
        if robot is not None:
            self._robot = robot_motion.OdometryInput(self, path_of_base)
        kind, _, topic = path.partition(":")
        if kind not in markers.ANCHOR_TYPES:
            self._use_anchors(load_anchors(Path(path).expanduser()))
        self._anchors_out = self.publisher(MarkerArray, topics.ANCHORS, endpoints.LATCHED)
        if kind in markers.ANCHOR_TYPES:
            # Some publishers send the anchors once for late subscribers, others repeatedly.
            for qos in (endpoints.LATCHED, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)):
                self.subscription(markers.ANCHOR_TYPES[kind], topic, self._on_anchors, qos)
        if topic := self.value("height_topic"):
            self.subscription(PoseWithCovarianceStamped, topic, self._on_height)
        self.steady_timer(PERIOD_S, self._on_timer)

    def begin(self) -> None:
        self._good_s = time.monotonic()
        self._show_anchors()
        self.get_logger().info("locating")

    def close(self) -> None:
        super().close()
        self._outputs, self._anchors_out, self._tf, self._estimator = {}, None, None, None
        self._robot, self._transform_ns = None, {}

    def describe(self) -> diagnostics.Description:
        estimator = self._estimator
        if estimator is None:
            return "host", diagnostics.WARN, "no anchors", {}
        monitors = [outputs.monitor for outputs in self._outputs.values()]
        sentences = {monitor.name: monitor.sentence() for monitor in monitors}
        # The estimators know nothing of the time after the last range of a tag.
        stale = tuple(
            f"{monitor.name}{end}" for monitor in monitors if monitor.age_s > STALE_S for end in ": "
        )
        values = {key: value for key, value in estimator.diagnostics().items() if not key.startswith(stale)}
        bad = {name: text for name, (is_good, text) in sentences.items() if not is_good}
        warnings = [text for name, text in bad.items() if f"{name}:" not in stale]
        # The sentences contain the statements on ambiguous positions.
        said = {f"{name}: {values.get(f'{name} determination')}" for name in sentences}
        warnings += [text for text in estimator.warnings() if not text.startswith(stale) and text not in said]
        for outputs in self._outputs.values():
            if self.count_publishers(outputs.pose.topic_name) > 1:
                warnings.append(
                    f"another node publishes {outputs.pose.topic_name}: stop it, or set a namespace"
                )
        if not estimator.tags and self._ranges_topic and not self.count_publishers(self._ranges_topic):
            warnings.append(f"no ranges: {self._ranges_topic} has no publisher. Start driver and mitigator")
        # Tags that are gone must not hide other warnings.
        warnings += [text for name, text in bad.items() if f"{name}:" in stale]
        good = "; ".join(text for _, text in list(sentences.values())[:5])
        self._log(warnings, good)
        if self._robot is not None and (warning := self._robot.warning()):
            warnings.insert(0, warning)
            self.get_logger().warning(warning, throttle_duration_sec=60.0)
        level = diagnostics.WARN if warnings else diagnostics.OK
        text = "; ".join(warnings[:5]) or good or "no ranges yet"
        values |= {"dropped by a queue": self._lost, "malformed": self._malformed}
        for outputs in self._outputs.values():
            name = outputs.monitor.name
            values[f"{name} lever arm"] = ",".join(f"{m:.3f}" for m in self._lever_arm_of(outputs))
            values[f"{name} position"] = sentences[name][1]
            if outputs.monitor.age_s <= STALE_S:
                values[f"{name} mean residuals m"] = outputs.monitor.residuals()
        values |= self._meter.entries()
        values |= diagnostics.percentiles("processing", diagnostics.drain(self._processing_ns))
        return "host", level, text, values

    def _log(self, warnings: list[str], good: str) -> None:
        """Log warnings that last, and their end: each search of a position begins with some."""
        if not warnings:
            if self._has_warned and good:
                self.get_logger().info(good)
            self._good_s, self._has_warned = time.monotonic(), False
        elif time.monotonic() - self._good_s > LOG_AFTER_S:
            self._has_warned = True
            self.get_logger().warning("; ".join(warnings[:5]), throttle_duration_sec=60.0)

    def _subscribe_to_ranges(self, source: str) -> float:
        """Subscribe to the topics of a mapping or to a topic; return the standard deviation in the mapping, m, 0: unknown."""
        if source:
            # Mapping files need pandas and pydantic, which other ranges do not.
            topic = importlib.import_module("uwb_mitigation.nodes.feeds.topic")
            mapping: Mapping | None = topic.find_mapping(source)
            if mapping is not None:
                feed: TopicFeed = topic.TopicFeed(self, mapping, "", self._on_mapped_range, self.now_ns)
                self.destroy_at_close(feed, lambda feed: feed.stop()).start()
                return mapping.range_sd
        kind, name = RangeCir if source else RangeCorrected, source or topics.relative(topics.RANGE_CORRECTED)
        self._decode = (
            (lambda data: _uncorrected(codec.decode_range(data))) if source else codec.decode_corrected
        )
        self._ranges_topic = self.resolve_topic_name(name)
        ranges = endpoints.create_raw_subscription(self, kind, name, self._on_range, self._on_lost)
        self.destroy_at_close(ranges, self.destroy_subscription)
        return 0.0

    def _on_mapped_range(self, measurement: RangeMeasurement) -> None:
        if self._estimator is not None and self.is_active:
            self._update_lever_arm(measurement.tag_id, lambda: measurement.frame_id)
            self._add(self._estimator, *_uncorrected(measurement))

    def _on_anchors(self, message: Any) -> None:
        """Use the first anchors that a topic sends."""
        if self._estimator is None and (anchors := markers.anchors_in(message)) is not None:
            self._use_anchors(anchors)
            if self.is_active:
                self._show_anchors()

    def _use_anchors(self, anchors: AnchorMap) -> None:
        self.get_logger().info(f"{len(anchors)} anchors from {self.value('anchors')}")
        digest = hashlib.sha256(repr(anchors.anchors).encode()).hexdigest()

        def read(saved: Any) -> tuple[int, robot_motion.MotionState | None]:
            if saved["anchors"] != digest:
                raise ValueError("other anchors")
            return int(saved["tag"]), saved["motion"] and robot_motion.MotionState.read(saved["motion"])

        if (state := self._state_file.load(robot_motion.HOLD_S, read)) is not None:
            self._plain_tag, motion = self._plain_tag or state[0], state[1]
            if self._robot is not None and motion is not None:
                self._robot.resume(motion)
        self._digest, self._estimator = digest, self._make_estimator(anchors)

    def _saved_state(self) -> dict[str, Any]:
        """Return the state for a process that replaces this one: the keys of its file."""
        state = None if self._robot is None else self._robot.state
        motion = None if state is None or state.map_to_odom is None else asdict(state)
        return {"anchors": self._digest, "tag": self._plain_tag, "motion": motion}

    def _on_lost(self, info: Any) -> None:
        self._lost += info.total_count_change

    def _on_range(self, messages: Iterator[tuple[bytes, int]]) -> None:
        # Subscriptions stay active while a lifecycle node is inactive.
        if self._estimator is not None and self.is_active:
            for data, _ in messages:
                self._take(self._estimator, data)

    def _take(self, estimator: MultiTagEstimator, data: bytes) -> None:
        try:
            key, corrected = self._decode(data)
        except RecordingError as error:
            self._malformed += 1
            self.get_logger().warning(f"a message cannot be read: {error}", throttle_duration_sec=10.0)
            return
        self._update_lever_arm(key.tag_id, lambda: codec.decode_frame_id(data))
        self._add(estimator, key, corrected)

    def _add(
        self, estimator: MultiTagEstimator, key: codec.MeasurementKey, corrected: CorrectedRange
    ) -> None:
        began_ns = time.perf_counter_ns()
        stamp_ns = key.stamp_ns + self._offset_ns
        measured = corrected.range_m, corrected.variance_m2, corrected.status.is_corrected
        result = estimator.add(key.tag_id, key.anchor_id, stamp_ns, *measured)
        if result is None:
            if key.anchor_id in estimator.unknown_anchors and key.anchor_id not in self._unknown_anchors:
                self._unknown_anchors.add(key.anchor_id)
                self.get_logger().warning(
                    f"ranges of anchor {format_id(key.anchor_id)} are left out: it is not in the anchors file"
                )
            return
        tag, estimate = result
        outputs = self._outputs_of(tag)
        row = estimator.anchors.index[key.anchor_id]
        outputs.picture.statuses[row] = corrected.status
        outputs.monitor.add(estimator.anchors.anchors[row], corrected, estimate)
        held_estimate = None
        if estimate is None and self._robot is not None and outputs.robot is not None:
            held_estimate = self._robot.without_estimate(stamp_ns)
        base = estimate or held_estimate
        if base is not None and not 0 <= stamp_ns - outputs.published_ns < self._period_ns:
            if stamp_ns < outputs.published_ns - NS_PER_S:
                # A replay starts again.
                self._transform_ns.clear()
            outputs.published_ns = stamp_ns
            if held_estimate is None:
                self._publish_estimate(outputs, base)
            else:
                self._publish_base(outputs, held_estimate)
        self._processing_ns.append(time.perf_counter_ns() - began_ns)
        self._meter.add(self.now_ns() - key.stamp_ns)

    def _outputs_of(self, tag: TagState) -> _Outputs:
        outputs = self._outputs.get(tag.tag_id)
        if outputs is None:
            self._plain_tag = self._plain_tag or tag.tag_id
            plain = tag.tag_id == self._plain_tag
            name = self._plain_frame if plain else poses.tag_frame(tag.tag_id)
            # Tags of several robots share the map, so the namespace keeps their frames apart.
            frame = f"{self.get_namespace()}/{name}".lstrip("/")
            outputs = _Outputs(self, tag, None if plain else tag.tag_id, frame)
            self._outputs[tag.tag_id] = outputs
            self.get_logger().info(f"tag {format_id(tag.tag_id)} on {outputs.pose.topic_name}")
        return outputs

    def _update_lever_arm(self, tag_id: int, frame: Callable[[], str]) -> None:
        """Set the lever arm of the robot's antenna when the frame of its ranges is known on /tf_static."""
        outputs, motion = self._outputs.get(tag_id), self._robot
        if outputs is None or outputs.robot is None or motion is None or motion.lever_arm_is_set:
            return
        if (arm := motion.lever_arm(frame())) is not None:
            outputs.robot.lever_arm, motion.lever_arm_is_set = arm, True
            self.get_logger().info(f"lever arm of the antenna: {arm[0]:.3f}, {arm[1]:.3f}, {arm[2]:.3f} m")

    def _publish_estimate(self, outputs: _Outputs, estimate: Estimate) -> None:
        outputs.picture.add(estimate)
        base = self._at_base(outputs, estimate)
        if self._robot is not None and outputs.robot is not None:
            if not self._robot.is_resuming(estimate.stamp_ns):
                trusts = not outputs.robot.rejects_odometry
                self._publish_base(outputs, self._robot.mixed(base, trusts_odometry=trusts))
            return
        outputs.pose.publish(poses.encode_pose(base, self._map))
        outputs.odometry.publish(poses.encode_odometry(estimate, self._map, outputs.frame))
        if self._tf is not None:
            pose = estimate.stamp_ns, self._map, outputs.frame, estimate.position.tolist()
            self._publish_transform(robot_motion.make_transform(*pose), estimate.stamp_ns)

    def _publish_base(self, outputs: _Outputs, base: Estimate) -> None:
        """Publish the pose of the robot, and the transform from map to odom."""
        motion, robot = self._robot, outputs.robot
        assert motion is not None
        assert robot is not None
        outputs.pose.publish(poses.encode_pose(base, self._map))
        twist = poses.BodyTwist() if robot.rejects_odometry else motion.twist(base.stamp_ns)
        frame = motion.state.base_frame or "base_link"
        outputs.odometry.publish(poses.encode_odometry(base, self._map, frame, twist))
        self._publish_transform(motion.map_to_odom(base, self._tolerance_ns), base.stamp_ns)

    def _publish_transform(
        self, transform: TransformStamped | None, stamp_ns: int, after_ns: int = 1
    ) -> None:
        """Publish a transform if its estimate is later by `after_ns` than its last one: tf warns of a repeated stamp."""
        if self._tf is None or transform is None:
            return
        frame = transform.child_frame_id
        if stamp_ns - self._transform_ns.get(frame, -(1 << 62)) >= after_ns:
            self._transform_ns[frame] = stamp_ns
            self._tf.publish(self._tf_type(transforms=[transform]))

    def _lever_arm_of(self, outputs: _Outputs) -> tuple[float, float, float]:
        if self._robot is not None and outputs.robot is None:
            # The lever arm is that of the robot's tag.
            return 0.0, 0.0, 0.0
        return self._lever_arm if outputs.robot is None else outputs.robot.lever_arm

    def _at_base(self, outputs: _Outputs, estimate: Estimate) -> Estimate:
        """Return the estimate of the robot's origin. With an unknown heading, a horizontal lever arm may point anywhere."""
        x, y, z = self._lever_arm_of(outputs)
        covariance, heading = estimate.covariance.copy(), estimate.heading
        if heading is None:
            covariance[[0, 1], [0, 1]] += (x * x + y * y) / 2.0
            return replace(estimate, position=estimate.position - (0.0, 0.0, z), covariance=covariance)
        cosine, sine = math.cos(heading.yaw), math.sin(heading.yaw)
        arm_x, arm_y = cosine * x - sine * y, sine * x + cosine * y
        to_base = np.eye(4)
        to_base[:2, 3] = arm_y, -arm_x
        pose = np.zeros((4, 4))
        pose[:3, :3] = covariance[:3, :3]
        pose[3] = pose[:, 3] = heading.covariance
        pose = to_base @ pose @ to_base.T
        covariance[:3, :3] = pose[:3, :3]
        position = estimate.position - (arm_x, arm_y, z)
        return replace(
            estimate, position=position, covariance=covariance, heading=Heading(heading.yaw, pose[3])
        )

    def _on_timer(self) -> None:
        estimator, stamp_ns = self._estimator, self.now_ns() + self._offset_ns
        if estimator is None or not self.is_active:
            return
        for tag in list(estimator.tags.values()):
            outputs = self._outputs_of(tag)
            age_s = (stamp_ns - tag.latest_ns) / NS_PER_S
            if PREDICT_AFTER_S < age_s < PREDICT_UNTIL_S:
                predicted = tag.best.predict_at(stamp_ns)
                if predicted is not None:
                    self._publish_estimate(outputs, predicted)
            elif outputs.smoothed_ns != tag.latest_ns and outputs.smoothed.get_subscription_count():
                outputs.smoothed_ns = tag.latest_ns
                smoothed = tag.smoother.estimate()
                if smoothed is not None:
                    outputs.smoothed.publish(poses.encode_pose(self._at_base(outputs, smoothed), self._map))
        if self._robot is not None:
            # Also before the first range after a crash.
            latest_ns = max((tag.latest_ns for tag in estimator.tags.values() if tag.robot), default=stamp_ns)
            if stamp_ns - latest_ns < PREDICT_UNTIL_S * NS_PER_S:
                last = self._robot.last_map_to_odom(stamp_ns, self._tolerance_ns)
                self._publish_transform(last, stamp_ns, _REPEAT_AFTER_NS)
        if self._anchors_out is not None and estimator.tags and self._anchors_out.get_subscription_count():
            self._show_anchors()
        if estimator.tags:
            self._state_file.save(self._saved_state)
        else:
            # Not before the last transform is repeated after a crash: the first call takes long.
            poses.prepare_encoders()

    def _show_anchors(self) -> None:
        estimator, publisher = self._estimator, self._anchors_out
        if estimator is None or publisher is None:
            return
        now_ns = self.now_ns()
        shown = markers.anchor_markers(estimator.anchors, self._map, now_ns)
        for number, tag in enumerate(estimator.tags.values()):
            picture = self._outputs_of(tag).picture
            received = tag.estimator.received_anchors()
            shown += markers.tag_markers(picture, received, estimator.anchors, self._map, number, now_ns)
        publisher.publish(MarkerArray(markers=shown))

    def _on_height(self, message: PoseWithCovarianceStamped) -> None:
        # With several tags, it is unknown to which tag this height belongs.
        if self._estimator is not None and len(self._estimator.tags) == 1:
            (tag,) = self._estimator.tags.values()
            tag.add_height(float(message.pose.pose.position.z), float(message.pose.covariance[14]))


def _uncorrected(measurement: RangeMeasurement) -> tuple[codec.MeasurementKey, CorrectedRange]:
    """Return a raw range with the status of one that was not corrected; its variance is `range_sd`."""
    range_m = measurement.range_m
    corrected = CorrectedRange(range_m, range_m, 0.0, math.nan, Status.NO_CIR, CorrectedBy.HOST, 0)
    return codec.measurement_key(measurement), corrected
