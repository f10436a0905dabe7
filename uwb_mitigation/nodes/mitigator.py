"""The node `mitigator`: subscribes to `/uwb/range_raw`, publishes `/uwb/range_corrected`."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.subscription import Subscription
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.measurement import Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes import diagnostics, messages, topics
from uwb_mitigation.nodes.parameters import Parameter, declare
from uwb_mitigation.nodes.running import run

PARAMETERS = (
    Parameter("model", "", "Model bundle to correct with; empty = the shipped one."),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)


class Mitigator(LifecycleNode):
    """Lifecycle: configure makes publisher and subscription, activate loads the model.

    A model that cannot be loaded leaves the node inactive and says so in the log and in the
    diagnostics; activating again, when the file is mended, loads it. Nothing is published while
    inactive, and nothing is queued.
    """

    def __init__(self) -> None:
        super().__init__("mitigator")
        declare(self, PARAMETERS)
        self._mitigation: Mitigation | None = None
        self._error: UwbMitigationError | None = None
        self._statuses: Counter[Status] = Counter()
        self._meter = diagnostics.Meter()
        # rclpy serialises at once: one message serves every publication.
        self._message = RangeCorrected()
        self._raw: Subscription | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.RANGES)
        self.create_timer(1.0, self._publish_diagnostics)
        if self._value("autostart"):
            self.trigger_configure()
            self.trigger_activate()

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._corrected = self.create_lifecycle_publisher(
            RangeCorrected, topics.RANGE_CORRECTED, topics.RANGES
        )
        self._raw = self.create_subscription(RangeCir, topics.RANGE_RAW, self._correct, topics.RANGES)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        path = Path(self._value("model")).expanduser() if self._value("model") else None
        try:
            bundle = load_bundle(path or default_model_path())
            self._mitigation = Mitigation(bundle)
        except UwbMitigationError as error:
            self._error = error
            self.get_logger().error(f"stays inactive: {error}")
            return TransitionCallbackReturn.FAILURE
        self._error = None
        self.get_logger().info(f"correcting with model {bundle.name}, id {bundle.model_id:08x}")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._mitigation = None
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def _close(self) -> None:
        self._mitigation = None
        if self._raw is not None:
            self.destroy_subscription(self._raw)
            self.destroy_lifecycle_publisher(self._corrected)
            self._raw = None

    def _correct(self, raw: RangeCir) -> None:
        # Subscriptions go on firing while a lifecycle node is inactive.
        if self._mitigation is None:
            return
        measurement = messages.from_range_cir(raw)
        corrected = self._mitigation.correct(measurement)
        messages.fill_range_corrected(self._message, raw, corrected)
        self._corrected.publish(self._message)
        self._statuses[corrected.status] += 1
        self._meter.add(self.get_clock().now().nanoseconds - measurement.stamp_ns)

    def _publish_diagnostics(self) -> None:
        state = self._state_machine.current_state
        level, text = diagnostics.OK, "correcting"
        if self._error is not None:
            level, text = diagnostics.ERROR, f"inactive: {self._error}"
        elif state[0] != State.PRIMARY_STATE_ACTIVE:
            level, text = diagnostics.WARN, f"not active: {state[1]}"
        facts: dict[str, object] = {f"ranges {status.name}": self._statuses[status] for status in Status}
        facts |= self._meter.facts()
        if self._mitigation is not None:
            bundle = self._mitigation.bundle
            facts |= {"model": bundle.name, "model id": f"{bundle.model_id:08x}"}
        self._diagnostics.publish(diagnostics.report(self, "host", level, text, facts))


def main() -> None:
    sys.exit(run(lambda stop: Mitigator()))
