"""The node `driver`: publishes measurements on `/uwb/range_raw`, from a recording, the simulator or a board.

Reading, parsing and simulating live in `sources`, the board's protocol in `link`. A board that runs the
model itself is also heard on `/uwb/range_corrected`.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.link.layout import Mode
from uwb_mitigation.link.messages import Correction
from uwb_mitigation.link.port import BoardPort, PortAddress
from uwb_mitigation.measurement import Origin, RangeMeasurement
from uwb_mitigation.nodes import diagnostics, messages, topics
from uwb_mitigation.nodes.agreement import Agreement
from uwb_mitigation.nodes.board_feed import BoardFeed
from uwb_mitigation.nodes.parameters import Parameter, declare
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
    Parameter("simulated_rate", 40.0, "Simulated exchanges a second, over all pairs, Hz.",
              low=0.1, high=10_000.0),
    Parameter("rate", 1.0, "Speed of a replay relative to the recording.", low=0.001, high=10_000.0),
    Parameter("loop", False, "Start a replay over when it ends; otherwise the node exits then."),
    Parameter("longest_pause", 5.0, "Pauses of a recording longer than this are cut to it, s of recorded time.",
              low=0.0, high=1e6),
    Parameter("publish_clock", False, "Publish the recording's time on /clock, and stamp with it. "
              "Run the other nodes with use_sim_time."),
    Parameter("wait_for_subscribers", 1, "A replay waits until so many subscribe to its ranges.",
              low=0, high=1000),
    Parameter("longest_wait", 10.0, "A replay starts all the same after this long without them, s.",
              low=0.0, high=3600.0),
    Parameter("start_delay", 3.0, "Pause before the first range of a replay once they are there, s: time "
              "for the rest of the graph to start and connect.", low=0.0, high=3600.0),
    Parameter("port", "", "Serial port of the board: a path such as /dev/ttyACM0, or "
              "usb:VENDOR:PRODUCT[:SERIAL] with ids in hexadecimal, wherever it is plugged in (serial)."),
    Parameter("baud", 921_600, "Of a serial line, bit/s; native USB ignores it (serial).",
              low=1200, high=12_000_000),
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


class Driver(LifecycleNode):
    """Lifecycle: configure opens the source, activate feeds from it (a recording from its start).

    A port is opened at activate; that it is absent is no error, it is waited for.

    Args:
        ended: set when a replay has come to its end.

    Attributes:
        exit_code: of the process, once `ended` is set.
    """

    def __init__(self, ended: threading.Event) -> None:
        super().__init__("driver")
        self._ended = ended
        declare(self, PARAMETERS)
        self.exit_code = 0
        self._source: Source | None = None
        self._address: PortAddress | None = None
        self._feed: ReplayFeed | BoardFeed | None = None
        self._agreement = Agreement()
        self._error: UwbMitigationError | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.RANGES)
        self.create_timer(1.0, self._publish_diagnostics)
        self.add_on_set_parameters_callback(self._on_parameters)
        if self._value("autostart"):
            self._autostart()

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _autostart(self) -> None:
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self._error is not None:
            # Without a lifecycle manager nobody will mend the parameters of a running node.
            raise self._error

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            if self._value("source") == "serial":
                self._address = PortAddress.parse(self._value("port"))
                self._board_model = _model_id(self._value("board_model"))
            else:
                self._source = open_source(self._value)
        except UwbMitigationError as error:
            self._error = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._error = None
        self._ranges = self.create_lifecycle_publisher(RangeCir, topics.RANGE_RAW, topics.RANGES)
        if self._address is not None:
            self._corrected = self.create_lifecycle_publisher(
                RangeCorrected, topics.RANGE_CORRECTED, topics.RANGES
            )
            self._host_ranges = self.create_subscription(
                RangeCorrected, topics.RANGE_CORRECTED, self._compare, topics.RANGES
            )
            return TransitionCallbackReturn.SUCCESS
        self._truths = self.create_lifecycle_publisher(RangeTruth, topics.RANGE_TRUTH, topics.RANGES)
        self._clock_publisher = None
        if self._value("publish_clock"):
            self._clock_publisher = self.create_publisher(ClockMessage, topics.CLOCK, 10)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._feed = self._make_board_feed() if self._address is not None else self._make_replay_feed()
        result = super().on_activate(state)
        self._feed.start()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        self._stop()
        if self._source is not None:
            self._source.close()
        super().destroy_node()

    def _make_replay_feed(self) -> ReplayFeed:
        assert self._source is not None
        own_clock = self._value("publish_clock")
        return ReplayFeed(
            self._source,
            # A node that drives /clock must not wait for /clock.
            Clock(clock_type=ClockType.STEADY_TIME) if own_clock else self.get_clock(),
            self.get_logger(),
            rate=self._value("rate"),
            loop=self._value("loop"),
            longest_pause_s=self._value("longest_pause"),
            recorded_stamps=own_clock,
            subscribers=self._ranges.get_subscription_count,
            wanted_subscribers=self._value("wait_for_subscribers"),
            longest_wait_s=self._value("longest_wait"),
            start_delay_s=self._value("start_delay"),
            publish=self._publish_record,
            on_time=self._publish_clock,
            on_end=self._finish,
        )

    def _make_board_feed(self) -> BoardFeed:
        assert self._address is not None
        clock = self.get_clock()
        port = BoardPort(
            self._address,
            baud=self._value("baud"),
            dtr=self._value("dtr"),
            mode=Mode[self._value("mode").upper()],
            expected_model_id=self._board_model,
            stamp_clock=lambda: int(clock.now().nanoseconds),
        )
        return BoardFeed(
            port,
            on_range=self._publish_range,
            on_correction=self._publish_correction,
            now_ns=lambda: int(clock.now().nanoseconds),
            logger=self.get_logger(),
        )

    def _on_parameters(self, changes: list[Any]) -> SetParametersResult:
        for change in changes:
            if (
                change.name == "mode"
                and isinstance(self._feed, BoardFeed)
                and change.value.upper() in Mode.__members__
            ):
                self._feed.port.set_mode(Mode[change.value.upper()])
        return SetParametersResult(successful=True)

    def _stop(self) -> None:
        if self._feed is not None:
            self._feed.stop()

    def _close(self) -> None:
        self._stop()
        if self._source is not None:
            self._source.close()
            self._source = None
            self.destroy_lifecycle_publisher(self._ranges)
            self.destroy_lifecycle_publisher(self._truths)
            if self._clock_publisher is not None:
                self.destroy_publisher(self._clock_publisher)
        elif self._address is not None:
            self._address = None
            self.destroy_lifecycle_publisher(self._ranges)
            self.destroy_lifecycle_publisher(self._corrected)
            self.destroy_subscription(self._host_ranges)

    def _publish_record(self, record: Record, stamp_ns: int) -> None:
        measurement = record.measurement
        header = messages.to_header(stamp_ns, measurement.frame_id or self._value("frame_id"))
        if record.truth is not None:
            self._truths.publish(messages.to_range_truth(record.truth, measurement, header))
        self._ranges.publish(messages.to_range_cir(measurement, header))

    def _publish_clock(self, recorded_ns: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ClockMessage(clock=Time(nanoseconds=recorded_ns).to_msg()))

    def _publish_range(self, measurement: RangeMeasurement) -> None:
        header = messages.to_header(measurement.stamp_ns, self._value("frame_id"))
        self._ranges.publish(messages.to_range_cir(measurement, header))

    def _publish_correction(self, correction: Correction) -> None:
        header = messages.to_header(correction.stamp_ns, self._value("frame_id"))
        message = messages.to_range_corrected(correction, header)
        self._corrected.publish(message)
        if self._value("mode") == "both":
            self._agreement.add_device(messages.key_of(message), correction.corrected)

    def _compare(self, message: RangeCorrected) -> None:
        """The mitigator's result for a range that the board has corrected too."""
        if message.source == Origin.HOST and self._value("mode") == "both":
            # Anybody may publish there; a status of no known meaning is not the mitigator's.
            with contextlib.suppress(ValueError):
                self._agreement.add_host(messages.key_of(message), messages.from_range_corrected(message))

    def _finish(self, error: UwbMitigationError | None) -> None:
        """The recording has ended: see that everything arrived, and leave."""
        self._ranges.wait_for_all_acked(Duration(seconds=5))
        self._error = error
        if error is not None:
            self.get_logger().error(str(error))
            self.exit_code = 1
        self._ended.set()

    def _publish_diagnostics(self) -> None:
        state = self._state_machine.current_state
        level, text, hardware = diagnostics.OK, "", "none"
        facts: dict[str, object] = {}
        if self._feed is not None:
            hardware, level, text, facts = self._feed.describe()
        if self._address is not None and self._value("mode") == "both":
            facts |= self._agreement.facts()
            if self._agreement.different:
                level, text = diagnostics.ERROR, "board and host disagree"
        if self._error is not None:
            level, text = diagnostics.ERROR, str(self._error)
        elif state[0] != State.PRIMARY_STATE_ACTIVE:
            level, text = diagnostics.WARN, f"not active: {state[1]}"
        self._diagnostics.publish(diagnostics.report(self, hardware, level, text, facts))


def main() -> None:
    sys.exit(run(Driver))
