"""The node `driver`: publishes measurements from a source on `/uwb/range_raw`.

It opens the source, stamps, and hands messages on; reading, parsing and simulating live in `sources`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeTruth

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.nodes import diagnostics, messages, topics
from uwb_mitigation.nodes.parameters import Parameter, declare
from uwb_mitigation.nodes.playback import Playback
from uwb_mitigation.nodes.running import run
from uwb_mitigation.sources.source import Record, Source

PARAMETERS = (
    Parameter("source", "simulated", "Where measurements come from.",
              choices=("mcap", "decaranging", "simulated")),
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
    Parameter("frame_id", "uwb_antenna", "Frame of the receiving antenna, where the source names none."),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip


def _recording_path(path: str) -> Path:
    if not path:
        raise ParameterError("parameter path is empty", valid="the recording to replay, as -p path:=FILE")
    return Path(path).expanduser()


def open_source(value: Callable[[str], Any]) -> Source:
    """The source that the parameters describe; `value(name)` gives a parameter's value.

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


class Driver(LifecycleNode):
    """Lifecycle: configure opens the source, activate plays it from its start, cleanup closes it.

    Attributes:
        exit_code: of the process, once the node has shut its context down.
    """

    def __init__(self) -> None:
        super().__init__("driver")
        declare(self, PARAMETERS)
        self.exit_code = 0
        self._source: Source | None = None
        self._playback: Playback | None = None
        self._error: UwbMitigationError | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.RANGES)
        self.create_timer(1.0, self._publish_diagnostics)
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
            self._source = open_source(self._value)
        except UwbMitigationError as error:
            self._error = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._error = None
        self._ranges = self.create_lifecycle_publisher(RangeCir, topics.RANGE_RAW, topics.RANGES)
        self._truths = self.create_lifecycle_publisher(RangeTruth, topics.RANGE_TRUTH, topics.RANGES)
        self._clock_publisher = None
        if self._value("publish_clock"):
            self._clock_publisher = self.create_publisher(ClockMessage, topics.CLOCK, 10)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        assert self._source is not None
        self.get_logger().info(f"replaying {self._source.name}")
        own_clock = self._value("publish_clock")
        self._activated_ns = time.monotonic_ns()
        self._connected_ns: int | None = None
        self._playback = Playback(
            self._source,
            # A node that drives /clock must not wait for /clock.
            Clock(clock_type=ClockType.STEADY_TIME) if own_clock else self.get_clock(),
            rate=self._value("rate"),
            loop=self._value("loop"),
            longest_pause_s=self._value("longest_pause"),
            recorded_stamps=own_clock,
            ready=self._is_ready,
            publish=self._publish,
            on_time=self._publish_clock,
            on_end=self._finish,
        )
        result = super().on_activate(state)
        self._playback.start()
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

    def _stop(self) -> None:
        if self._playback is not None:
            self._playback.stop()

    def _close(self) -> None:
        self._stop()
        if self._source is None:
            return
        self._source.close()
        self._source = None
        self.destroy_lifecycle_publisher(self._ranges)
        self.destroy_lifecycle_publisher(self._truths)
        if self._clock_publisher is not None:
            self.destroy_publisher(self._clock_publisher)

    def _is_ready(self) -> bool:
        """True once enough others listen and the graph had time to settle, or they did not come."""
        now_ns = time.monotonic_ns()
        if self._connected_ns is None:
            if self._ranges.get_subscription_count() >= self._value("wait_for_subscribers"):
                self._connected_ns = now_ns
            elif now_ns - self._activated_ns >= self._value("longest_wait") * 1e9:
                self.get_logger().warning(
                    f"{self._ranges.get_subscription_count()} subscribe to {self._ranges.topic_name} "
                    f"instead of {self._value('wait_for_subscribers')}; playing all the same"
                )
                return True
            return False
        return bool(now_ns - self._connected_ns >= self._value("start_delay") * 1e9)

    def _publish(self, record: Record, stamp_ns: int) -> None:
        measurement = record.measurement
        header = messages.to_header(stamp_ns, measurement.frame_id or self._value("frame_id"))
        if record.truth is not None:
            self._truths.publish(messages.to_range_truth(record.truth, measurement, header))
        self._ranges.publish(messages.to_range_cir(measurement, header))

    def _publish_clock(self, recorded_ns: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ClockMessage(clock=Time(nanoseconds=recorded_ns).to_msg()))

    def _finish(self, error: UwbMitigationError | None) -> None:
        """The recording has ended: see that everything arrived, and leave."""
        assert self._playback is not None
        assert self._source is not None
        self._ranges.wait_for_all_acked(Duration(seconds=5))
        self._error = error
        skipped = ", ".join(f"{count} x {kind}" for kind, count in sorted(self._source.skipped.items()))
        self.get_logger().info(
            f"played {self._playback.played} ranges" + (f"; oddities: {skipped}" if skipped else "")
        )
        if error is not None:
            self.get_logger().error(str(error))
            self.exit_code = 1
        self.context.try_shutdown()

    def _publish_diagnostics(self) -> None:
        state = self._state_machine.current_state
        level, text = diagnostics.OK, "publishing"
        if self._error is not None:
            level, text = diagnostics.ERROR, str(self._error)
        elif state[0] != State.PRIMARY_STATE_ACTIVE:
            level, text = diagnostics.WARN, f"not active: {state[1]}"
        facts: dict[str, object] = {}
        if self._source is not None:
            facts = {"source": self._source.name, "simulated": self._source.simulated}
            facts |= {f"oddity: {kind}": count for kind, count in self._source.skipped.copy().items()}
        if self._playback is not None:
            facts["ranges published"] = self._playback.played
        hardware = "simulated" if facts.get("simulated") else "recording"
        self._diagnostics.publish(diagnostics.report(self, hardware, level, text, facts))


def main() -> None:
    sys.exit(run(Driver))
