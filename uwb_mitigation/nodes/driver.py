"""The node `driver`: publishes measurements on `/uwb/range_raw`, from a recording, the simulator, a topic or radios.

A board that runs the model itself also publishes on `/uwb/range_corrected`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock, ClockType

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes.feeds import radios
from uwb_mitigation.nodes.feeds.publishing import RangePublisher
from uwb_mitigation.nodes.feeds.replay import ReplayFeed, open_source
from uwb_mitigation.nodes.support import diagnostics
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.nodes.support.lifecycle import ManagedNode, refuse_errors
from uwb_mitigation.nodes.support.parameter_tables import DAMAGED, DRIVER
from uwb_mitigation.nodes.support.respawn import RespawnState, unused_path
from uwb_mitigation.types.measurement import RangeMeasurement

if TYPE_CHECKING:
    from uwb_mitigation.nodes.mitigator import Mitigator


class Driver(ManagedNode):
    """Lifecycle: configure opens the source, activate starts its feed (a recording from its start).

    A port is opened at activate. A missing port is not an error: the feed waits for it.

    Args:
        ended: set when a replay has ended.
        consumer: in-process consumer of measurements; `/uwb/range_raw` is then published only if it has subscribers.

    Attributes:
        exit_code: exit code of the process; valid when `ended` is set.
    """

    def __init__(self, ended: threading.Event, consumer: Mitigator | None = None) -> None:
        super().__init__("driver")
        self._ended = ended
        self._consumer = consumer
        self.exit_code = 0
        self._has_finished = False
        self._make_feed: Callable[[], radios.SourceHandle] | None = None
        self._feed: radios.SourceHandle | None = None
        self._output: RangePublisher
        self._respawn_state = RespawnState(self.respawn_file("run"))
        if (code := self._respawn_state.exit_code) is not None:
            self.get_logger().info("the recording has ended before this process was started: it ends, too")
            self._end_process(code)
            return
        refuse_errors(self, self._check)
        self.add_post_set_parameters_callback(self._apply)
        self.autostart()

    def open(self) -> None:
        # Each function checks its parameters, opens its source, and returns the factory of its feed.
        prepare = self._prepare_topics if self.value("source") == "topic" else self._prepare_replay
        self._make_feed = self._prepare_radios() if self._has_radios else prepare()

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
        if self._has_finished:
            # Not earlier: after a crash before the bag is complete, the recording is replayed again.
            self._respawn_state.save(self.exit_code)

    def describe(self) -> Description:
        return ("none", diagnostics.OK, "", {}) if self._feed is None else self._feed.describe()

    @property
    def _has_radios(self) -> bool:
        is_capture = self.value("source") in radios.CAPTURED_SOURCES and self.value("path")
        return self.value("source") in radios.RADIO_SOURCES and not is_capture

    def _prepare_radios(self) -> Callable[[], radios.SourceHandle]:
        source = radios.radio_source(self.value("source"))
        source.read_settings(self.value)
        output = self._create_publisher(corrections=self.value("source") == "serial")
        return lambda: radios.RadioFeed(source, self._file_value, output, self.now_ns, self.get_logger())

    def _prepare_topics(self) -> Callable[[], radios.SourceHandle]:
        # Mapping files need pandas and pydantic, which the other sources do not.
        from uwb_mitigation.nodes.feeds.topic import TopicFeed
        from uwb_mitigation.recordings.mapping.mapping import load_mapping

        mapping = load_mapping(self.value("map"))
        self._create_publisher()
        feed = TopicFeed(self, mapping, self.value("topic"), self._publish_topic_range, self.now_ns)
        return lambda: feed

    def _prepare_replay(self) -> Callable[[], radios.SourceHandle]:
        source = self.destroy_at_close(open_source(self.value), lambda source: source.close())
        output = self._create_publisher(recording=True)
        robot = None
        if self.value("source") == "mcap":
            # Other sources do not need the readers of bags.
            from uwb_mitigation.nodes.feeds.robot_messages import RobotMessages

            robot = RobotMessages(self)
        # A node that publishes /clock must not wait for /clock.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        clock = steady if self.value("publish_clock") else self.get_clock()
        return lambda: ReplayFeed(source, clock, self.value, self.get_logger(), output, self._finish, robot)

    def _create_publisher(self, *, corrections: bool = False, recording: bool = False) -> RangePublisher:
        record = self._file_value("record")
        self._output = RangePublisher(self, self._consumer, record, corrections, recording)
        return self._output

    def _file_value(self, name: str) -> Any:
        """Return a parameter; a file that is written is a new one after a crash, so that the earlier one is kept."""
        value = self.value(name)
        if name in ("record", "capture") and value and self._respawn_state.is_respawned:
            path = Path(value).expanduser()
            new_path = unused_path(path)
            if new_path != path:
                self.get_logger().info(f"{name} continues after a crash in {new_path}")
            return str(new_path)
        return value

    def _check(self, values: Mapping[str, Any]) -> None:
        """Raise for settings of radios that contradict each other, and for offsets that cannot be read."""
        if self._has_radios:
            # rclpy calls the callback that was added last first: check the types here, too.
            for row in DRIVER:
                if row.name in values:
                    row.check(values[row.name])
            source = radios.radio_source(self.value("source"))
            source.read_settings(lambda name: values.get(name, self.value(name)))

    def _apply(self, changes: list[Any]) -> None:
        """Pass live parameters, already checked, to the feed."""
        if self._feed is not None:
            self._feed.apply({change.name for change in changes}, self.value)

    def _publish_topic_range(self, measurement: RangeMeasurement) -> None:
        if self.is_active:
            self._output.publish_range(measurement)

    def _finish(self, error: UwbMitigationError | None) -> None:
        """End the node after all messages are acknowledged."""
        self._output.wait_for_all_acked()
        self.error = error
        if error is not None:
            self.get_logger().error(str(error))
        self._has_finished = True
        self._end_process(0 if error is None else DAMAGED)

    def _end_process(self, code: int) -> None:
        self.exit_code = code
        self._ended.set()
