"""What the lifecycle nodes of this package share: transitions that can be repeated, and errors that show.

rclpy swallows what a transition raises. Here it is logged, kept for the diagnostics, and whatever the
transition had opened is closed again, so that the same transition may be asked for once more.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.subscription import Subscription

from uwb_mitigation.errors import UwbMitigationError, not_imported
from uwb_mitigation.nodes import diagnostics, topics
from uwb_mitigation.nodes.parameter_tables import Parameter
from uwb_mitigation.nodes.parameters import declare, warn_of_unknown_qos


class Namesakes:
    """Finds out whether another node has the name of this one: ROS then mixes up their parameters and transitions.

    A node that was killed stays in the graph for some seconds. So the graph is only a hint, and diagnostics under the
    node's name that this node has not sent are the proof.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._subscription: Subscription | None = None
        self._sent: deque[tuple[int, int]] = deque(maxlen=10)
        self._found = False

    def sent(self, report: DiagnosticArray) -> None:
        self._sent.append((report.header.stamp.sec, report.header.stamp.nanosec))

    def problems(self) -> list[str]:
        """Return what is wrong in a line; empty if the name is unique."""
        node = self._node
        own = (node.get_name(), node.get_namespace())
        shared = node.get_node_names_and_namespaces().count(own) > 1
        if shared and self._subscription is None:
            self._subscription = node.create_subscription(
                DiagnosticArray, topics.DIAGNOSTICS, self._on_report, 10
            )
        elif not shared and self._subscription is not None:
            node.destroy_subscription(self._subscription)
            self._subscription, self._found = None, False
        name = node.get_fully_qualified_name()
        remedy = "give it a namespace (-r __ns:=/left) or a name (-r __node:=left)"
        return [f"another node has the name {name}: {remedy}"] if self._found else []

    def _on_report(self, message: DiagnosticArray) -> None:
        name = diagnostics.name_of(self._node)
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        self._found |= stamp not in self._sent and any(status.name == name for status in message.status)


class ManagedNode(LifecycleNode):
    """A lifecycle node with a parameter table and one diagnostic status a second.

    A subclass says what each transition does: `open` (configure), `begin` (activate), `end` (deactivate) and
    `close` (cleanup, shutdown). `end` and `close` must stand being called when there is nothing to end
    or to close.

    Args:
        table: the node's parameters.
        foreign: names of parameters that belong to another node of this process, and are no mistake.

    Attributes:
        error: why the latest transition failed; None after one that succeeded.
    """

    def __init__(self, name: str, table: Sequence[Parameter], foreign: Collection[str] = ()) -> None:
        super().__init__(name)
        declare(self, table, foreign)
        self.error: UwbMitigationError | None = None
        self._namesakes = Namesakes(self)
        self._reported: set[str] = set()
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        # By a steady clock: diagnostics are wanted most when the node's own clock stands still.
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def open(self) -> None:
        raise NotImplementedError

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def describe(self) -> tuple[str, bytes, str, dict[str, object]]:
        """Hardware id, level, message and facts for the diagnostics."""
        raise NotImplementedError

    def autostart(self) -> None:
        """Configure and activate, if the parameter `autostart` says so.

        Raises:
            UwbMitigationError: configure failed, and without a lifecycle manager nobody will mend it.
        """
        if not self.value("autostart"):
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self.error is not None:
            raise self.error

    def value(self, name: str) -> Any:
        """The value of a parameter."""
        return self.get_parameter(name).value

    @property
    def is_active(self) -> bool:
        return bool(self._state_machine.current_state[0] == State.PRIMARY_STATE_ACTIVE)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._attempt(self.open, self.close)
        if result == TransitionCallbackReturn.SUCCESS:
            # Those of quality of service are declared with the publishers and subscriptions.
            warn_of_unknown_qos(self)
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Publishers first: `begin` may start threads that publish.
        super().on_activate(state)
        result = self._attempt(self.begin, self.end)
        if result != TransitionCallbackReturn.SUCCESS:
            super().on_deactivate(state)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._attempt(self.end)
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt(self._end_and_close)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt(self._end_and_close)

    def destroy_node(self) -> None:
        self._end_and_close()
        super().destroy_node()

    def _end_and_close(self) -> None:
        self.end()
        self.close()

    def _attempt(self, step: Callable[[], None], undo: Callable[[], None] | None = None) -> Any:
        try:
            step()
        except UwbMitigationError as error:
            self.error = error
        except Exception as error:
            self.error = not_imported(error) if isinstance(error, ImportError) else None
            if self.error is None:
                self.get_logger().error(traceback.format_exc())
                self.error = UwbMitigationError(
                    f"{type(error).__name__}: {error}", valid="see the log: a bug"
                )
        else:
            self.error = None
            return TransitionCallbackReturn.SUCCESS
        self.get_logger().error(str(self.error))
        if undo is not None:
            undo()
        return TransitionCallbackReturn.FAILURE

    def _publish_diagnostics(self) -> None:
        label = self._state_machine.current_state[1]
        hardware, level, text, facts = self.describe()
        if self.error is not None:
            level, text = diagnostics.ERROR, f"{label}: {self.error}"
        elif not self.is_active:
            level, text = diagnostics.WARN, f"not active: {label}"
        problems = [*topics.not_received(self), *self._namesakes.problems()]
        for problem in problems:
            if problem not in self._reported:
                self.get_logger().warning(problem)
        self._reported = set(problems)
        if problems:
            text = "; ".join([*problems, text] if level > diagnostics.OK else problems)
            level = max(level, diagnostics.WARN)
        report = diagnostics.report(self, hardware, level, text, facts)
        self._namesakes.sent(report)
        self._diagnostics.publish(report)
