"""Declares a parameter table on a node, checks every value at start-up and at set time, and names parameter,
value and range in the refusal."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from uwb_mitigation.errors import ParameterError, UwbMitigationError, did_you_mean
from uwb_mitigation.files import write_whole
from uwb_mitigation.nodes.parameter_tables import KEPT_PARAMETERS, TABLES, Parameter

_QOS = "qos_overrides."


def describe(row: Parameter) -> ParameterDescriptor:
    """What ROS is told of a parameter."""
    # The type is left open to rclpy and checked here: it would refuse `2` for a float, and names
    # no parameter when it refuses a type.
    descriptor = ParameterDescriptor(
        description=row.description,
        read_only=not row.live,
        dynamic_typing=True,
    )
    descriptor.additional_constraints = row.valid if row.choices else ""
    if row.low is not None and row.high is not None:
        if isinstance(row.default, float):
            span = FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
            descriptor.floating_point_range = [span]
        elif isinstance(row.default, int) and not isinstance(row.default, bool):
            bounds = IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)
            descriptor.integer_range = [bounds]
    return descriptor


def declare(node: Node, table: Sequence[Parameter], foreign: Collection[str] = ()) -> None:
    """Declare a table on a node, refuse parameters that nobody knows, and guard later changes.

    Args:
        foreign: names that belong to another node of this process.

    Raises:
        ParameterError: a value given at start-up has the wrong type or lies out of its range, or its name is
            that of no parameter.
    """
    rows = {row.name: row for row in table}
    keep = _restore_live_parameters(node, {row.name for row in table if row.live})
    for row in table:
        try:
            node.declare_parameter(row.name, row.default, describe(row))
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"parameter {row.name}: {error}", valid=row.valid) from error
        row.check(node.get_parameter(row.name).value)
    _refuse_unknown(node, foreign)
    if keep is not None:
        node.add_post_set_parameters_callback(keep)

    def guard(changes: list[Any]) -> SetParametersResult:
        for change in changes:
            row = rows.get(change.name)
            if row is None:
                continue
            try:
                row.check(change.value)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(guard)


def _refuse_unknown(node: Node, foreign: Collection[str]) -> None:
    """Raise ParameterError for an unknown parameter that was given at start-up; log those of other nodes in one line."""
    everyones = {row.name for table in TABLES.values() for row in table}
    given = [name for name in _undeclared(node) if not name.startswith(_QOS) and name not in foreign]
    for name in given:
        if name not in everyones:
            known = [*foreign, *(known for known in node._parameters if not known.startswith(_QOS))]
            raise ParameterError(
                f"parameter {name} is unknown", valid=did_you_mean(name, known) or "see --help"
            )
    if given:
        node.get_logger().info(f"ignored, as they are parameters of other nodes: {', '.join(given)}")


def _restore_live_parameters(node: Node, live: Collection[str]) -> Callable[[list[Any]], None] | None:
    """Give a respawned node the parameters that were set while it ran; return the callback that keeps new ones."""
    folder = os.environ.get(KEPT_PARAMETERS)
    if not folder:
        return None
    path = Path(folder, node.get_fully_qualified_name().strip("/").replace("/", "."))
    kept: dict[str, Any] = {}
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        # rclpy offers no other way to the parameters given.
        node._parameter_overrides.update(
            {name: RosParameter(name, value=value) for name, value in kept.items()}
        )
        values = ", ".join(f"{name} = {value!r}" for name, value in kept.items())
        node.get_logger().info(f"restored after a restart, as set while the node ran: {values}")

    def keep(changes: list[Any]) -> None:
        kept.update({change.name: change.value for change in changes if change.name in live})
        try:
            write_whole(path, json.dumps(kept))
        except UwbMitigationError as error:
            node.get_logger().warning(f"parameters will be lost after a respawn: {error}")

    return keep


def warn_of_unknown_qos(node: Node) -> None:
    """Log every override of quality of service that is for no topic of the node, once its topics are made."""
    for name in _undeclared(node):
        if name.startswith(_QOS):
            hint = did_you_mean(name, [known for known in node._parameters if known.startswith(_QOS)])
            node.get_logger().warning(
                f"parameter {name} is unknown and has no effect" + (f": {hint}" if hint else "")
            )


def _undeclared(node: Node) -> list[str]:
    # rclpy offers no other way to the parameters given.
    return [name for name in sorted(node._parameter_overrides) if not node.has_parameter(name)]
