"""Base of the lifecycle nodes of this package: parameters, transitions, diagnostics and clocks."""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from uwb_mitigation.errors import (
    ParameterError,
    UwbMitigationError,
    check_name,
    did_you_mean,
    missing_dependency,
)
from uwb_mitigation.files import write_atomically
from uwb_mitigation.nodes.support import diagnostics, topics
from uwb_mitigation.nodes.support.parameter_tables import KEPT_PARAMETERS, TABLES, Parameter

DUPLICATE_NAME_DELAY_S = 40.0
"""A second node of the same name is reported after this time: a killed node stays in the graph for up to 20 s."""

_QOS = "qos_overrides."

Resource = TypeVar("Resource")


def clock_reader(clock: Clock) -> Callable[[], int]:
    """Return a function that returns the clock's time, ns; it calls rclpy, which is slow, only for simulated time."""
    if clock.clock_type == ClockType.STEADY_TIME:
        return time.monotonic_ns
    if clock.clock_type == ClockType.SYSTEM_TIME:
        return time.time_ns
    # The parameter use_sim_time may be set at any time.
    return lambda: int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()


class ManagedNode(LifecycleNode):
    """A lifecycle node with a parameter table and one diagnostic status per second.

    A subclass implements the transitions: `open` (configure), `begin` (activate), `end` (deactivate) and
    `close` (cleanup, shutdown). `end` and `close` may be called without `begin` or `open`.
    rclpy hides exceptions of a transition. This class logs them, shows them in the diagnostics, and closes what
    the transition has opened, so that it can be requested again.

    Args:
        table: the node's parameters.
        other_parameters: names of parameters of other nodes in this process.

    Attributes:
        error: the error of the latest transition; None after success.
    """

    def __init__(self, name: str, table: Sequence[Parameter], other_parameters: Collection[str] = ()) -> None:
        super().__init__(name)
        declare(self, table, other_parameters)
        self.error: UwbMitigationError | None = None
        self.now_ns = clock_reader(self.get_clock())
        self._last_unique_s = time.monotonic()
        self._reported: set[str] = set()
        self._opened: list[Callable[[], object]] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        # Use a steady clock: diagnostics must be published even if a simulated clock is paused.
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def open(self) -> None:
        raise NotImplementedError

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Destroy what `open` has created; a subclass also resets its attributes."""
        while self._opened:
            self._opened.pop()()

    def destroy_at_close(self, resource: Resource, destroy: Callable[[Resource], object]) -> Resource:
        """Return `resource`, and let `close` destroy it."""
        self._opened.append(partial(destroy, resource))
        return resource

    def publisher(self, kind: type, topic: str, qos: QoSProfile | None = None) -> Publisher:
        """Return a lifecycle publisher until `close`, by default with the QoS of ranges."""
        if qos is None:
            resource = topics.create_publisher(self, kind, topic)
        else:
            resource = self.create_lifecycle_publisher(kind, topic, qos)
        return self.destroy_at_close(resource, self.destroy_lifecycle_publisher)

    def describe(self) -> diagnostics.Description:
        """Return the content of the diagnostics."""
        raise NotImplementedError

    def autostart(self) -> None:
        """Configure and activate if the parameter `autostart` is set.

        Raises:
            UwbMitigationError: configure failed.
        """
        if not self.value("autostart"):
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self.error is not None:
            raise self.error

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    @property
    def is_active(self) -> bool:
        return bool(self._state_machine.current_state[0] == State.PRIMARY_STATE_ACTIVE)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._attempt(self.open, self.close)
        if result == TransitionCallbackReturn.SUCCESS:
            # QoS parameters are declared with the publishers and subscriptions.
            _warn_of_unknown_qos(self)
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Activate publishers first: `begin` may start threads that publish.
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

    on_shutdown = on_cleanup

    def destroy_node(self) -> None:
        self._end_and_close()
        super().destroy_node()

    def _end_and_close(self) -> None:
        self.end()
        self.close()

    def _attempt(self, step: Callable[[], None], on_failure: Callable[[], None] | None = None) -> Any:
        try:
            step()
        except UwbMitigationError as error:
            self.error = error
        except Exception as error:
            self.error = missing_dependency(error) if isinstance(error, ImportError) else None
            if self.error is None:
                self.get_logger().error(traceback.format_exc())
                self.error = UwbMitigationError(
                    f"{type(error).__name__}: {error}", valid="this is a bug: see the log"
                )
        else:
            self.error = None
            return TransitionCallbackReturn.SUCCESS
        self.get_logger().error(str(self.error))
        if on_failure is not None:
            on_failure()
        return TransitionCallbackReturn.FAILURE

    def _publish_diagnostics(self) -> None:
        label = self._state_machine.current_state[1]
        hardware, level, text, entries = self.describe()
        if self.error is not None:
            level, text = diagnostics.ERROR, f"{label}: {self.error}"
        elif not self.is_active:
            level, text = diagnostics.WARN, f"not active: {label}"
        problems = topics.incompatible_publishers(self) + self._duplicate_name_warnings()
        for problem in problems:
            if problem not in self._reported:
                self.get_logger().warning(problem)
        self._reported = set(problems)
        if problems:
            text = "; ".join([*problems, text] if level > diagnostics.OK else problems)
            level = max(level, diagnostics.WARN)
        self._diagnostics.publish(diagnostics.report(self, hardware, level, text, entries))

    def _duplicate_name_warnings(self) -> list[str]:
        """Return a warning if another node has this name: parameter and transition calls are then ambiguous."""
        own = (self.get_name(), self.get_namespace())
        if self.get_node_names_and_namespaces().count(own) < 2:
            self._last_unique_s = time.monotonic()
        if time.monotonic() - self._last_unique_s < DUPLICATE_NAME_DELAY_S:
            return []
        remedy = "set a namespace (-r __ns:=/left) or a name (-r __node:=left)"
        return [f"another node has the name {self.get_fully_qualified_name()}: {remedy}"]


def declare(node: Node, table: Sequence[Parameter], other_parameters: Collection[str] = ()) -> None:
    """Declare a table on a node, refuse unknown parameters, and check every later value.

    Args:
        node: the node.
        table: its parameters.
        other_parameters: names of parameters of other nodes in this process.

    Raises:
        ParameterError: a parameter given at start-up is unknown, or its value has the wrong type or range.
    """
    rows = {row.name: row for row in table}
    save_live_parameters = _restore_live_parameters(node, {row.name for row in table if row.live})
    for row in table:
        try:
            node.declare_parameter(row.name, row.default, _descriptor(row))
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"parameter {row.name}: {error}", valid=row.valid) from error
        row.check(node.get_parameter(row.name).value)
    _refuse_unknown(node, other_parameters)
    if save_live_parameters is not None:
        node.add_post_set_parameters_callback(save_live_parameters)

    def check(values: Mapping[str, Any]) -> None:
        for name in values.keys() & rows.keys():
            rows[name].check(values[name])

    refuse_errors(node, check)


def refuse_errors(node: Node, check: Callable[[Mapping[str, Any]], None]) -> None:
    """Refuse every later set of parameters, {name: value}, for which `check` raises a UwbMitigationError."""

    def checked(changes: list[Any]) -> SetParametersResult:
        try:
            check({change.name: change.value for change in changes})
        except UwbMitigationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(checked)


def _descriptor(row: Parameter) -> ParameterDescriptor:
    # Dynamic typing and own checks: rclpy refuses `2` for a float, and its error does not name the parameter.
    descriptor = ParameterDescriptor(
        description=row.description,
        read_only=not row.live,
        dynamic_typing=True,
        additional_constraints=row.valid if row.choices else "",
    )
    if row.low is not None and row.high is not None:
        if isinstance(row.default, float):
            span = FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
            descriptor.floating_point_range = [span]
        else:
            bounds = IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)
            descriptor.integer_range = [bounds]
    return descriptor


def _refuse_unknown(node: Node, other_parameters: Collection[str]) -> None:
    """Raise ParameterError for an unknown parameter; log the parameters of other nodes in one line."""
    all_nodes = {row.name for table in TABLES.values() for row in table}
    given = [name for name in _undeclared(node) if not name.startswith(_QOS) and name not in other_parameters]
    own = [*other_parameters, *(known for known in node._parameters if not known.startswith(_QOS))]
    for name in given:
        if name not in all_nodes:
            check_name("parameter", name, own, valid="--help lists them")
    if given:
        node.get_logger().info(f"ignored parameters of other nodes: {', '.join(given)}")


def _restore_live_parameters(node: Node, live: Collection[str]) -> Callable[[list[Any]], None] | None:
    """Restore the parameters that were set before a respawn; return the callback that saves new values."""
    folder = os.environ.get(KEPT_PARAMETERS)
    if not folder:
        return None
    path = Path(folder, node.get_fully_qualified_name().strip("/").replace("/", "."))
    saved: dict[str, Any] = {}
    if path.is_file():
        saved = json.loads(path.read_text(encoding="utf-8"))
        # rclpy has no public access to the parameters given at start-up.
        node._parameter_overrides.update(
            {name: RosParameter(name, value=value) for name, value in saved.items()}
        )
        values = ", ".join(f"{name} = {value!r}" for name, value in saved.items())
        node.get_logger().info(f"restored parameters after a respawn: {values}")

    def save_live_parameters(changes: list[Any]) -> None:
        saved.update({change.name: change.value for change in changes if change.name in live})
        try:
            write_atomically(path, json.dumps(saved))
        except UwbMitigationError as error:
            node.get_logger().warning(f"parameters will be lost after a respawn: {error}")

    return save_live_parameters


def _warn_of_unknown_qos(node: Node) -> None:
    """Log every QoS override for a topic that the node does not have."""
    known = [name for name in node._parameters if name.startswith(_QOS)]
    for name in _undeclared(node):
        if name.startswith(_QOS):
            hint = did_you_mean(name, known)
            node.get_logger().warning(
                f"unknown parameter {name!r} has no effect" + (f"; {hint}" if hint else "")
            )


def _undeclared(node: Node) -> list[str]:
    # rclpy has no public access to the parameters given at start-up.
    return [name for name in sorted(node._parameter_overrides) if not node.has_parameter(name)]
