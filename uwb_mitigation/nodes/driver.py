"""The node `driver`: publishes measurements on `/uwb/range_raw`, from a recording, the simulator or a board.

Reading, parsing and simulating live in `sources`, the board's protocol in `link`. A board that runs the
model itself is also heard on `/uwb/range_corrected`.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.bag.codec import encode_range
from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.link.layout import Mode
from uwb_mitigation.link.messages import Correction
from uwb_mitigation.link.port import BoardPort, PortAddress
from uwb_mitigation.measurement import Origin, RangeMeasurement
from uwb_mitigation.nodes import clocks, diagnostics, messages, topics
from uwb_mitigation.nodes.agreement import Agreement
from uwb_mitigation.nodes.board_feed import BoardFeed
from uwb_mitigation.nodes.lifecycle import ManagedNode
from uwb_mitigation.nodes.parameters import Parameter
from uwb_mitigation.nodes.replay_feed import ReplayFeed
from uwb_mitigation.nodes.running import run
from uwb_mitigation.sources.source import Record, Source

PARAMETERS = (
    Parameter("source", "simulated", "Where measurements come from.",
              choices=("mcap", "decaranging", "simulated", "serial")),
    Parameter("path", "", "Recording to replay: a bag (mcap), a log or a folder of logs (decaranging)."),
    Parameter("topic", "/uwb/range_raw", "Topic of the ranges inside the bag (mcap)."),
    Parameter("cir", "final", "Which frame's CIR belongs to a range (decaranging).",
              choices=("final", "poll")),
    Parameter("seed", 1, "Seed of the simulated measurements.", low=0, high=2**31 - 1),
    Parameter("count", 0, "Simulated measurements before the end; 0 = endless.", low=0, high=2**31 - 1),
    Parameter("simulated_rate", 40.0, "Simulated exchanges a second, over all pairs.",
              low=0.1, high=10_000.0, unit="Hz"),
    Parameter("rate", 1.0, "Speed of a replay relative to the recording.",
              low=0.001, high=10_000.0, live=True),
    Parameter("paused", False, "A replay stands still while this is set.", live=True),
    Parameter("seek_to", 0.0, "Where a replay starts, from the beginning of the recording; set while it runs, "
              "it goes on from there.", low=0.0, high=1e9, live=True, unit="s"),
    Parameter("loop", False, "Start a replay over when it ends; otherwise the node exits then."),
    Parameter("longest_pause", 5.0, "Pauses of a recording longer than this are cut to it, in recorded time.",
              low=0.0, high=1e6, unit="s"),
    Parameter("publish_clock", False, "Publish the recording's time on /clock, and stamp with it. "
              "Run the other nodes with use_sim_time."),
    Parameter("wait_for_subscribers", 1, "A replay waits until so many subscribe to its ranges.",
              low=0, high=1000),
    Parameter("longest_wait", 10.0, "A replay starts all the same after this long without them.",
              low=0.0, high=3600.0, unit="s"),
    Parameter("start_delay", 3.0, "Pause before the first range of a replay once they are there: time for the "
              "rest of the graph to start and connect.", low=0.0, high=3600.0, unit="s"),
    Parameter("port", "", "Serial port of the board: a path such as /dev/ttyACM0, or "
              "usb:VENDOR:PRODUCT[:SERIAL] with ids in hexadecimal, wherever it is plugged in (serial)."),
    Parameter("baud", 921_600, "Of a serial line; native USB ignores it (serial).",
              low=1200, high=12_000_000, unit="bit/s"),
    Parameter("dtr", True, "Level of DTR: boards with native USB send only while it is set; through a bridge, "
              "its change resets the board (serial)."),
    Parameter("mode", "host", "Who runs the model: the host, the device, or both, to compare them (serial).",
              choices=("host", "device", "both"), live=True),
    Parameter("board_model", "", "Model id that the board must hold, eight hexadecimal digits; its corrections "
              "by another model are withheld. Empty = any (serial)."),
    Parameter("frame_id", "uwb_antenna", "Frame of the receiving antenna, where the source names none."),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip


def _recording_path(path: str) -> Path:
    if not path:
        raise ParameterError("parameter path is empty", valid="the recording to replay, as -p path:=FILE")
    return Path(path).expanduser()


def open_source(value: Callable[[str], Any]) -> Source:
    """The recording or simulation that the parameters describe; `value(name)` gives a parameter's value.

    Raises:
        ParameterError, RecordingError: there is no such source.
    """
    # Each kind imports its own dependencies, and only when it is wanted.
    kind = value("source")
    if kind == "mcap":
        from uwb_mitigation.sources.mcap import McapRecording

        return McapRecording(_recording_path(value("path")), topic=value("topic"))
    if kind == "decaranging":
        from uwb_mitigation.sources.decaranging import CirOf, open_decaranging

        return open_decaranging(_recording_path(value("path")), cir=CirOf(value("cir")))
    from uwb_mitigation.sources.simulated import SimulatedSource

    return SimulatedSource(seed=value("seed"), count=value("count"), rate_hz=value("simulated_rate"))


def _model_id(digits: str) -> int | None:
    """Raise ParameterError unless `digits` is empty or eight hexadecimal digits."""
    if not digits:
        return None
    try:
        if len(digits) == 8:
            return int(digits, 16)
    except ValueError:
        pass
    raise ParameterError(f"parameter board_model = {digits!r}", valid="eight hexadecimal digits, or empty")


class Consumer(Protocol):
    """Who takes measurements in the same process: the mitigator of a pipeline."""

    def correct(self, measurements: Sequence[RangeMeasurement]) -> None: ...

    def subscription_count(self) -> int: ...

    def wait_for_all_acked(self, timeout: Duration) -> None: ...


class Driver(ManagedNode):
    """Lifecycle: configure opens the source, activate feeds from it (a recording from its start).

    A port is opened at activate; that it is absent is no error, it is waited for.

    Args:
        ended: set when a replay has come to its end.
        consumer: takes the measurements; `/uwb/range_raw` is then published only if someone subscribes.
        foreign: see `ManagedNode`.

    Attributes:
        exit_code: of the process, once `ended` is set.
    """

    def __init__(
        self, ended: threading.Event, consumer: Consumer | None = None, foreign: Collection[str] = ()
    ) -> None:
        super().__init__("driver", PARAMETERS, foreign)
        self._ended = ended
        self._consumer = consumer
        self.exit_code = 0
        self._source: Source | None = None
        self._address: PortAddress | None = None
        self._feed: ReplayFeed | BoardFeed | None = None
        self._agreement = Agreement()
        self._ranges: Publisher | None = None
        self._corrected: Publisher | None = None
        self._truths: Publisher | None = None
        self._clock_publisher: Publisher | None = None
        self._host_ranges: Subscription | None = None
        self._frame_id: str = self.value("frame_id")
        self.add_post_set_parameters_callback(self._apply)
        self.autostart()

    def open(self) -> None:
        if self.value("source") == "serial":
            self._address = PortAddress.parse(self.value("port"))
            self._board_model = _model_id(self.value("board_model"))
        else:
            self._source = open_source(self.value)
        self._ranges = topics.create_publisher(self, RangeCir, topics.RANGE_RAW)
        if self._address is not None:
            self._corrected = topics.create_publisher(self, RangeCorrected, topics.RANGE_CORRECTED)
            self._host_ranges = topics.create_subscription(
                self, RangeCorrected, topics.RANGE_CORRECTED, self._compare
            )
            return
        self._truths = topics.create_publisher(self, RangeTruth, topics.RANGE_TRUTH)
        if self.value("publish_clock"):
            self._clock_publisher = self.create_publisher(ClockMessage, topics.CLOCK, 10)

    def begin(self) -> None:
        self._feed = self._make_board_feed() if self._address is not None else self._make_replay_feed()
        self._feed.start()

    def end(self) -> None:
        if self._feed is not None:
            self._feed.stop()

    def close(self) -> None:
        self._feed = None
        self._address = None
        if self._source is not None:
            self._source.close()
            self._source = None
        for publisher in (self._ranges, self._corrected, self._truths):
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        self._ranges = self._corrected = self._truths = None
        if self._clock_publisher is not None:
            self.destroy_publisher(self._clock_publisher)
            self._clock_publisher = None
        if self._host_ranges is not None:
            self.destroy_subscription(self._host_ranges)
            self._host_ranges = None

    def _make_replay_feed(self) -> ReplayFeed:
        assert self._source is not None
        assert self._ranges is not None
        own_clock = self.value("publish_clock")
        return ReplayFeed(
            self._source,
            # A node that drives /clock must not wait for /clock.
            Clock(clock_type=ClockType.STEADY_TIME) if own_clock else self.get_clock(),
            self.get_logger(),
            rate=self.value("rate"),
            loop=self.value("loop"),
            longest_pause_s=self.value("longest_pause"),
            recorded_stamps=own_clock,
            subscribers=self._ranges.get_subscription_count
            if self._consumer is None
            else self._consumer.subscription_count,
            wanted_subscribers=self.value("wait_for_subscribers"),
            longest_wait_s=self.value("longest_wait"),
            start_delay_s=self.value("start_delay"),
            paused=self.value("paused"),
            from_s=self.value("seek_to"),
            publish=self._publish_records,
            on_time=self._publish_clock,
            on_end=self._finish,
        )

    def _make_board_feed(self) -> BoardFeed:
        assert self._address is not None
        now_ns = clocks.reader(self.get_clock())
        port = BoardPort(
            self._address,
            baud=self.value("baud"),
            dtr=self.value("dtr"),
            mode=Mode[self.value("mode").upper()],
            expected_model_id=self._board_model,
            stamp_clock=now_ns,
        )
        return BoardFeed(
            port,
            on_range=self._publish_range,
            on_correction=self._publish_correction,
            now_ns=now_ns,
            logger=self.get_logger(),
        )

    def _apply(self, changes: list[Any]) -> None:
        """Pass live parameters, accepted by now, to what they govern."""
        for change in changes:
            if isinstance(self._feed, BoardFeed) and change.name == "mode":
                self._feed.port.set_mode(Mode[change.value.upper()])
            elif isinstance(self._feed, ReplayFeed):
                playback = self._feed.playback
                if change.name == "rate":
                    playback.rate = float(change.value)
                elif change.name == "paused":
                    playback.paused = change.value
                elif change.name == "seek_to":
                    playback.seek(float(change.value))

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
            if record.truth is not None and self._truths is not None:
                header = messages.to_header(stamp_ns, measurement.frame_id)
                self._truths.publish(messages.to_range_truth(record.truth, measurement, header))
        self._publish_measurements(measurements)

    def _publish_clock(self, recorded_ns: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ClockMessage(clock=Time(nanoseconds=recorded_ns).to_msg()))

    def _publish_range(self, measurement: RangeMeasurement) -> None:
        self._publish_measurements([replace(measurement, frame_id=self._frame_id)])

    def _publish_measurements(self, measurements: Sequence[RangeMeasurement]) -> None:
        assert self._ranges is not None
        if self._consumer is not None:
            self._consumer.correct(measurements)
            if not self._ranges.get_subscription_count():
                return
        for measurement in measurements:
            # Serialised here: rclpy would need three times as long for its objects.
            self._ranges.publish(encode_range(measurement))

    def _publish_correction(self, correction: Correction) -> None:
        header = messages.to_header(correction.stamp_ns, self._frame_id)
        message = messages.to_range_corrected(correction, header)
        assert self._corrected is not None
        self._corrected.publish(message)
        if self.value("mode") == "both":
            self._agreement.add_device(messages.key_of(message), correction.corrected)

    def _compare(self, message: RangeCorrected) -> None:
        """The mitigator's result for a range that the board has corrected too."""
        if message.source == Origin.HOST and self.value("mode") == "both":
            # Anybody may publish there; a status of no known meaning is not the mitigator's.
            with contextlib.suppress(ValueError):
                self._agreement.add_host(messages.key_of(message), messages.from_range_corrected(message))

    def _finish(self, error: UwbMitigationError | None) -> None:
        """The recording has ended: see that everything arrived, and leave."""
        assert self._ranges is not None
        self._ranges.wait_for_all_acked(Duration(seconds=5))
        if self._consumer is not None:
            self._consumer.wait_for_all_acked(Duration(seconds=5))
        self.error = error
        if error is not None:
            self.get_logger().error(str(error))
            self.exit_code = 1
        self._ended.set()

    def describe(self) -> tuple[str, bytes, str, dict[str, object]]:
        level, text, hardware = diagnostics.OK, "", "none"
        facts: dict[str, object] = {}
        if self._feed is not None:
            hardware, level, text, facts = self._feed.describe()
        if self._address is not None and self.value("mode") == "both":
            facts |= self._agreement.facts()
            if self._agreement.different:
                level, text = diagnostics.ERROR, "board and host disagree"
        return hardware, level, text, facts


def main() -> None:
    sys.exit(run(lambda ended: [Driver(ended)]))
