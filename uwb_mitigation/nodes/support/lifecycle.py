"""Base of the lifecycle nodes of this package: parameters, transitions, diagnostics and clocks."""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.impl.implementation_singleton import rclpy_implementation as rcl
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from uwb_mitigation.errors import ParameterError, UwbMitigationError, check_name
from uwb_mitigation.files import write_atomically
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.parameter_tables import ALL_TABLES, RESPAWN_FOLDER, STANDARD, Parameter
from uwb_mitigation.nodes.support.spinning import correctable_error
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.topics import relative

DUPLICATE_NAME_DELAY_S = 40.0
"""A second node of the same name is reported after this time: a killed node stays in the graph for up to 20 s."""

_TRANSIENT = (OSError, rcl.RCLError, rcl.RMWError, rcl.RCUtilsError)
"""Errors of the system and of ROS, which may have disappeared when a launch file respawns the node."""

_DECLARED_BY_RCLPY = ("use_sim_time", "start_type_description_service")

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

    A subclass implements the transitions: `open` (configure), and if necessary `begin` (activate), `end` (deactivate) and
    `close` (cleanup, shutdown). `end` and `close` may be called without `begin` or `open`.
    rclpy hides exceptions of a transition. This class logs them, shows them in the diagnostics, and closes what
    the transition has opened, so that it can be requested again.

    Args:
        name: of the node; its parameters are those in `ALL_TABLES`.

    Attributes:
        error: the error of the latest transition; None after success.
        given_parameters: {name: value} of all parameters given at start-up, also those of other nodes.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.given_parameters: dict[str, Any] = self._take_given_parameters()
        self._declare({row.name: row for row in ALL_TABLES[name]})
        self.error: UwbMitigationError | None = None
        self._transient: Exception | None = None
        self._state = "unconfigured"
        self.now_ns = clock_reader(self.get_clock())
        self._last_unique_s = time.monotonic()
        self._reported: set[str] = set()
        self._opened: list[Callable[[], object]] = []
        (change_state,) = [service for service in self.services if service.srv_type is ChangeState]
        change_state.callback = partial(self._answer_change_state, change_state.callback)
        self._diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        # Use a steady clock: diagnostics must be published even if a simulated clock is paused.
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def open(self) -> None:
        raise NotImplementedError

    def begin(self) -> None:
        """Do nothing: lifecycle publishers send while the node is active."""

    def end(self) -> None:
        """Do nothing, see `begin`."""

    def close(self) -> None:
        """Destroy what `open` has created; a subclass also resets its attributes."""
        while self._opened:
            self._opened.pop()()

    def destroy_at_close(self, resource: Resource, destroy: Callable[[Resource], object]) -> Resource:
        """Return `resource`, and let `close` destroy it."""
        self._opened.append(partial(destroy, resource))
        return resource

    def publisher(self, kind: type, topic: str, qos: QoSProfile | None = None) -> Publisher:
        """Return a lifecycle publisher in the node's namespace until `close`, by default with the QoS of ranges."""
        if qos is None:
            resource = endpoints.create_publisher(self, kind, relative(topic))
        else:
            resource = self.create_lifecycle_publisher(kind, relative(topic), qos)
        if self.is_active:
            # `on_activate` activates the others.
            resource.on_activate(None)
        return self.destroy_at_close(resource, self.destroy_lifecycle_publisher)

    def subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile | int | None = None
    ) -> Subscription:
        """Return a subscription until `close`; by default one of ranges that also receives best-effort messages."""
        if qos is None:
            best_effort = ReliabilityPolicy.BEST_EFFORT
            resource = endpoints.create_subscription(self, kind, topic, callback, best_effort)
        else:
            resource = self.create_subscription(kind, topic, callback, qos)
        return self.destroy_at_close(resource, self.destroy_subscription)

    def steady_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call `callback` periodically until `close`, also while a simulated clock is paused."""
        timer = self.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.destroy_at_close(timer, self.destroy_timer)

    def respawn_file(self, suffix: str) -> Path | None:
        """Return a file with which this node continues after a crash; None: it is not respawned by a launch file."""
        folder = os.environ.get(RESPAWN_FOLDER)
        name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        return Path(folder, f"{name}.{suffix}") if folder else None

    def describe(self) -> diagnostics.Description:
        """Return the content of the diagnostics."""
        raise NotImplementedError

    def autostart(self) -> None:
        """Configure and activate if the parameter `autostart` is set.

        Raises:
            UwbMitigationError: configure failed.
            OSError, RuntimeError: configure failed with an error of the system or of ROS, which may be transient.
        """
        if not self.value("autostart"):
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self.error is not None:
            raise self._transient or self.error

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    @property
    def is_active(self) -> bool:
        return self._state == "active"

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("inactive", self.open, self.close)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Activate publishers first: `begin` may start threads that publish.
        super().on_activate(state)
        result = self._attempt("active", self.begin, self.end)
        if result != TransitionCallbackReturn.SUCCESS:
            super().on_deactivate(state)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._attempt("inactive", self.end)
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("unconfigured", self._end_and_close)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("finalized", self._end_and_close)

    def destroy_node(self) -> None:
        self._end_and_close()
        super().destroy_node()

    def _answer_change_state(self, change_state: Callable[..., Any], request: Any, response: Any) -> Any:
        """Refuse a transition that is not possible in this state, for which rclpy would end the process."""
        try:
            return change_state(request, response)
        except RuntimeError as error:  # rclpy's RCLError
            self.get_logger().warning(f"transition {request.transition.id} refused: {error}")
            response.success = False
            return response

    def _end_and_close(self) -> None:
        self.end()
        self.close()

    def _attempt(
        self, state: str, step: Callable[[], None], on_failure: Callable[[], None] | None = None
    ) -> TransitionCallbackReturn:
        """Run a step; after success the node is in `state`."""
        self._transient = None
        try:
            step()
        except Exception as error:
            self.error = correctable_error(error)
            if self.error is None:
                self._transient = error if isinstance(error, _TRANSIENT) else None
                self.get_logger().error(traceback.format_exc())
                remedy = "see the log" if self._transient else "this is a bug: see the log"
                self.error = UwbMitigationError(f"{type(error).__name__}: {error}", valid=remedy)
        else:
            self.error, self._state = None, state
            return TransitionCallbackReturn.SUCCESS
        self.get_logger().error(str(self.error))
        if on_failure is not None:
            on_failure()
        return TransitionCallbackReturn.FAILURE

    def _publish_diagnostics(self) -> None:
        hardware, level, text, entries = self.describe()
        if self.error is not None:
            level, text = diagnostics.ERROR, f"{self._state}: {self.error}"
        elif not self.is_active:
            level, text = diagnostics.WARN, f"not active: {self._state}"
        problems = endpoints.incompatible_publishers(self) + self._duplicate_name_warnings()
        for problem in problems:
            if problem not in self._reported:
                self.get_logger().warning(problem)
        self._reported = set(problems)
        if problems:
            text = "; ".join([*problems, text] if level > diagnostics.OK else problems)
            level = max(level, diagnostics.WARN)
        self._diagnostics.publish(diagnostics.diagnostic_array(self, hardware, level, text, entries))

    def _duplicate_name_warnings(self) -> list[str]:
        """Return a warning if another node has this name: parameter and transition calls are then ambiguous."""
        full_name = (self.get_name(), self.get_namespace())
        if self.get_node_names_and_namespaces().count(full_name) < 2:
            self._last_unique_s = time.monotonic()
        if time.monotonic() - self._last_unique_s < DUPLICATE_NAME_DELAY_S:
            return []
        remedy = "set a namespace (-r __ns:=/left) or a name (-r __node:=left)"
        return [f"another node has the name {self.get_fully_qualified_name()}: {remedy}"]

    def _take_given_parameters(self) -> dict[str, Any]:
        """Return the parameters given at start-up, and undeclare them, so that each is declared with its description."""
        declared = self.get_parameters_by_prefix("")
        names = [name for name in declared if name not in _DECLARED_BY_RCLPY]
        for name in names:
            self.undeclare_parameter(name)
        return {name: declared[name].value for name in names}

    def _declare(self, rows: Mapping[str, Parameter]) -> None:
        """Declare the parameters of a table, refuse unknown parameters, and check every later value.

        Raises:
            ParameterError: a parameter given at start-up is unknown, or its value has the wrong type or range.
        """
        for row in rows.values():
            try:
                self.declare_parameter(row.name, row.default, _descriptor(row))
            except (InvalidParameterTypeException, InvalidParameterValueException) as error:
                raise ParameterError(f"parameter {row.name}: {error}", valid=row.valid) from error
            row.check(self.value(row.name))
        self._refuse_unknown(rows.keys())

        def check(values: Mapping[str, Any]) -> None:
            for name in values.keys() & rows.keys():
                rows[name].check(values[name])

        refuse_errors(self, check)
        self._keep_live_parameters({row.name for row in rows.values() if row.live})

    def _refuse_unknown(self, names: Collection[str]) -> None:
        """Raise ParameterError for a parameter of no node; log the parameters of other nodes in one line."""
        all_names = {row.name for table in ALL_TABLES.values() for row in table}
        given = [name for name in sorted(self.given_parameters) if not name.startswith(STANDARD)]
        for name in given:
            check_name("parameter", name, all_names, valid="--help lists them")
        if ignored := [name for name in given if name not in names]:
            self.get_logger().info(f"ignored parameters of other nodes: {', '.join(ignored)}")

    def _keep_live_parameters(self, live: Collection[str]) -> None:
        """Restore the parameters that were set before a respawn, and save those that are set from now on."""
        if (path := self.respawn_file("json")) is None:
            return
        saved: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        if saved:
            self.set_parameters([RosParameter(name, value=value) for name, value in saved.items()])
            values = ", ".join(f"{name} = {value!r}" for name, value in saved.items())
            self.get_logger().info(f"restored parameters after a respawn: {values}")

        def save(changes: list[Any]) -> None:
            saved.update({change.name: change.value for change in changes if change.name in live})
            try:
                write_atomically(path, json.dumps(saved))
            except UwbMitigationError as error:
                self.get_logger().warning(f"parameters will be lost after a respawn: {error}")

        self.add_post_set_parameters_callback(save)


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
