"""The node `driver`: publishes measurements on `/uwb/range_raw`, from a recording, the simulator, a board or radios.

`sources` reads and simulates, `link` has the protocol of boards, `radio` has the radios at this computer. A board
that runs the model itself also publishes on `/uwb/range_corrected`.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.nodes.feeds.radios import (
    PREFIX,
    BoardFeed,
    RadioFeed,
    SourceHandle,
    open_radios,
    settings_of,
)
from uwb_mitigation.nodes.feeds.replay import ReplayFeed
from uwb_mitigation.nodes.feeds.uci import UciFeed, uci_settings
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.nodes.support.lifecycle import ManagedNode, refuse_errors
from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.serial import BoardDriver
from uwb_mitigation.radios.settings import RadioSettings
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.radios.wire.messages import Correction
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment
from uwb_mitigation.types.offsets import NO_OFFSETS, read_offsets
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import encode_corrected, encode_range, encode_truth
from uwb_mitigation.types.ros.poses import encode_true_position, prepare_encoders
from uwb_mitigation.types.ros.topics import RANGE_RAW
from uwb_mitigation.types.source import Source

if TYPE_CHECKING:
    from uwb_mitigation.nodes.mitigator import Mitigator

_NO_CIR = Cir(np.zeros(0, np.int16))


def open_source(value: Callable[[str], Any]) -> Source:
    """Open the recording or simulation of the parameters; `value(name)` returns a parameter's value.

    Raises:
        ParameterError: the parameter path is empty.
        RecordingError: the recording cannot be read.
    """
    # Import here, because each source needs other dependencies.
    if value("source") == "simulated":
        from uwb_mitigation.simulation.simulated import SimulatedSource

        return SimulatedSource(seed=value("seed"), count=value("count"), rate_hz=value("simulated_rate"))
    if not value("path"):
        raise ParameterError("parameter path is empty", valid="the recording to replay, as -p path:=FILE")
    path = Path(value("path")).expanduser()
    if value("source") == "uci":
        from uwb_mitigation.radios.fira.capture import UciCapture

        return UciCapture(path)
    if value("source") == "mcap":
        from uwb_mitigation.recordings.mcap import McapRecording

        return McapRecording(path, topic=value("topic") or RANGE_RAW)
    from uwb_mitigation.recordings.decaranging import CirFrame, open_decaranging

    return open_decaranging(path, cir=CirFrame(value("cir")))


def _model_id(digits: str) -> int | None:
    """Raise ParameterError unless `digits` is empty or eight hexadecimal digits."""
    if not digits:
        return None
    if re.fullmatch("[0-9a-fA-F]{8}", digits):
        return int(digits, 16)
    raise ParameterError(f"parameter board_model = {digits!r}", valid="eight hexadecimal digits, or empty")


class Driver(ManagedNode):
    """Lifecycle: configure opens the source, activate starts its feed (a recording from its start).

    A port is opened at activate. A missing port is not an error: the feed waits for it.

    Args:
        ended: set when a replay has ended.
        consumer: in-process consumer of measurements; `/uwb/range_raw` is then published only if it has subscribers.
        other_parameters: see `ManagedNode`.

    Attributes:
        exit_code: exit code of the process; valid when `ended` is set.
    """

    def __init__(
        self,
        ended: threading.Event,
        consumer: Mitigator | None = None,
        other_parameters: Collection[str] = (),
    ) -> None:
        super().__init__("driver", DRIVER, other_parameters)
        self._ended = ended
        self._consumer = consumer
        self.exit_code = 0
        self._make_feed: Callable[[], SourceHandle] | None = None
        self._feed: SourceHandle | None = None
        # `open` creates the publishers that its source needs.
        self._ranges: Publisher
        self._corrected: Publisher
        self._truths: Publisher
        self._places: Publisher
        self._clock_publisher: Publisher
        self._sensor_ranges: endpoints.SensorRanges | None = None
        self._frame_id: str = self.value("frame_id")
        refuse_errors(self, self._check)
        self._offsets = self._prepared_offsets = NO_OFFSETS
        self.add_post_set_parameters_callback(self._apply)
        self.autostart()

    def open(self) -> None:
        # Each function checks its parameters, opens its source, and returns the factory of its feed.
        prepare = {
            "serial": self._prepare_board,
            "evb1000": self._prepare_radios,
            "spi": self._prepare_radios,
            "topic": self._prepare_topics,
        }
        if not self.value("path"):
            prepare["uci"] = self._prepare_uci
        self._make_feed = prepare.get(self.value("source"), self._prepare_replay)()
        self._ranges = self.publisher(RangeCir, topics.RANGE_RAW)

    def begin(self) -> None:
        assert self._make_feed is not None
        self._feed = self._make_feed()
        self._feed.start()

    def end(self) -> None:
        if self._feed is not None:
            self._feed.stop()

    def close(self) -> None:
        super().close()
        self._feed = self._make_feed = None
        self._sensor_ranges = None

    def describe(self) -> Description:
        return ("none", diagnostics.OK, "", {}) if self._feed is None else self._feed.describe()

    def _prepare_board(self) -> Callable[[], SourceHandle]:
        address = PortAddress.parse(self.value("port"))
        board_model = _model_id(self.value("board_model"))
        self._offsets = read_offsets(str(self.value("offsets")))
        self._corrected = self.publisher(RangeCorrected, topics.RANGE_CORRECTED)
        if self.value("sensor_ranges"):
            self._sensor_ranges = self.destroy_at_close(
                endpoints.SensorRanges(self), endpoints.SensorRanges.close
            )

        def make() -> BoardFeed:
            port = BoardDriver(
                address,
                baud=self.value("baud"),
                dtr=self.value("dtr"),
                mode=Mode[self.value("mode").upper()],
                expected_model_id=board_model,
                stamp_clock=self.now_ns,
            )
            log = self.get_logger()
            feed = BoardFeed(port, self._publish_range, self._publish_correction, self.now_ns, log)
            feed.apply(["offsets"], self.value, self._offsets)
            # A board whose radio is not configured here keeps its own settings.
            if settings_of(self.value) != RadioSettings():
                feed.apply([PREFIX], self.value, self._offsets)
            return feed

        return make

    def _prepare_radios(self) -> Callable[[], SourceHandle]:
        settings_of(self.value)

        def make() -> RadioFeed:
            radios = open_radios(self.value, self.now_ns)
            return RadioFeed(radios, self._publish_range, self.now_ns, self.get_logger())

        return make

    def _prepare_uci(self) -> Callable[[], SourceHandle]:
        uci_settings(self.value)
        return lambda: UciFeed(self.value, self._publish_range, self.now_ns, self.get_logger())

    def _prepare_topics(self) -> Callable[[], SourceHandle]:
        # Mapping files need pandas and pydantic, which the other sources do not.
        from uwb_mitigation.nodes.feeds.topic import TopicFeed
        from uwb_mitigation.recordings.mapping.mapping import load_mapping

        if not (name := self.value("map")):
            raise ParameterError(
                "parameter map is empty", valid="map:=FILE, or the name of a shipped mapping"
            )
        mapping = load_mapping(name)
        feed = TopicFeed(self, mapping, self.value("topic"), self._publish_topic_range, self.now_ns)
        return lambda: feed

    def _prepare_replay(self) -> Callable[[], SourceHandle]:
        source = self.destroy_at_close(open_source(self.value), lambda source: source.close())
        prepare_encoders()
        self._truths = self.publisher(RangeTruth, topics.RANGE_TRUTH)
        self._places = self.publisher(Odometry, topics.ODOMETRY_TRUTH)
        own_clock = self.value("publish_clock")
        if own_clock:
            clock = self.create_publisher(ClockMessage, topics.CLOCK, 10)
            self._clock_publisher = self.destroy_at_close(clock, self.destroy_publisher)

        def make() -> ReplayFeed:
            subscribed = self._ranges.get_subscription_count
            return ReplayFeed(
                source,
                # A node that publishes /clock must not wait for /clock.
                Clock(clock_type=ClockType.STEADY_TIME) if own_clock else self.get_clock(),
                self.value,
                self.get_logger(),
                subscribers=subscribed if self._consumer is None else self._consumer.subscription_count,
                publish=self._publish_records,
                on_time=self._publish_clock,
                on_end=self._finish,
            )

        return make

    def _check(self, values: Mapping[str, Any]) -> None:
        """Raise for radio settings that contradict each other, and for offsets that cannot be read."""
        if any(name.startswith(PREFIX) for name in values):
            check = uci_settings if self.value("source") == "uci" else settings_of
            check(lambda name: values.get(name, self.value(name)))
        if "offsets" in values:
            self._prepared_offsets = read_offsets(str(values["offsets"]))

    def _apply(self, changes: list[Any]) -> None:
        """Pass live parameters, already checked, to the feed."""
        changed = {change.name for change in changes}
        if "offsets" in changed:
            self._offsets = self._prepared_offsets
        if self._feed is not None:
            self._feed.apply(changed, self.value, self._offsets)

    def _publish_records(self, records: Sequence[tuple[Record, int]]) -> None:
        measurements = [
            replace(
                record.measurement,
                stamp_ns=stamp_ns,
                frame_id=record.measurement.frame_id or self._frame_id,
            )
            for record, stamp_ns in records
        ]
        for (record, stamp_ns), measurement in zip(records, measurements, strict=True):
            if record.truth is not None:
                self._truths.publish(encode_truth(measurement, record.truth))
            if record.tag_position is not None:
                true_pose = encode_true_position(
                    record.tag_position, measurement.tag_id, stamp_ns, record.tag_yaw
                )
                self._places.publish(true_pose)
        self._publish_measurements(measurements)

    def _publish_clock(self, recorded_ns: int) -> None:
        self._clock_publisher.publish(ClockMessage(clock=Time(nanoseconds=recorded_ns).to_msg()))

    def _publish_range(self, measurement: RangeMeasurement) -> None:
        cir = measurement.cir
        if cir.radio is RadioType.UNKNOWN:
            # The protocols of boards and local radios are those of the DW1000.
            cir = replace(cir, radio=RadioType.DW1000, segment=Segment.IPATOV)
        self._publish_measurements([replace(measurement, cir=cir, frame_id=self._frame_id)])

    def _publish_topic_range(self, measurement: RangeMeasurement) -> None:
        if self.is_active:
            self._publish_range(measurement)

    def _publish_measurements(self, measurements: Sequence[RangeMeasurement]) -> None:
        if self._consumer is not None:
            self._consumer.correct(measurements)
            if not self._ranges.get_subscription_count():
                return
        for measurement in measurements:
            # Serialise here: rclpy takes three times as long for its message objects.
            self._ranges.publish(encode_range(measurement))

    def _publish_correction(self, correction: Correction) -> None:
        c, raw_m = correction, correction.corrected.range_raw_m
        measurement = RangeMeasurement(
            c.stamp_ns, c.tag_id, c.anchor_id, c.sequence, c.device_time, raw_m, _NO_CIR, self._frame_id
        )
        self._corrected.publish(encode_corrected(measurement, correction.corrected))
        if self._sensor_ranges is not None:
            self._sensor_ranges.publish(
                correction.anchor_id, correction.stamp_ns, self._frame_id, correction.corrected
            )

    def _finish(self, error: UwbMitigationError | None) -> None:
        """End the node after all messages are acknowledged."""
        self._ranges.wait_for_all_acked(Duration(seconds=5))
        if self._consumer is not None:
            self._consumer.wait_for_all_acked(Duration(seconds=5))
        self.error = error
        if error is not None:
            self.get_logger().error(str(error))
            self.exit_code = 1
        self._ended.set()
