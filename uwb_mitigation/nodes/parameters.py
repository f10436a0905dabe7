"""Declares a parameter table on a node, checks every value at start-up and at set time, and names parameter,
value and range in the refusal."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.parameter_tables import TABLES, Parameter

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
    for row in table:
        try:
            node.declare_parameter(row.name, row.default, describe(row))
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"parameter {row.name}: {error}", valid=row.valid) from error
        row.check(node.get_parameter(row.name).value)
    _refuse_unknown(node, foreign)

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
    """Raise ParameterError for a parameter that was given at start-up and is none; warn of another node's."""
    everyones = {row.name for table in TABLES.values() for row in table}
    for name in _undeclared(node):
        if name.startswith(_QOS) or name in foreign:
            continue
        if name in everyones:
            node.get_logger().warning(f"parameter {name} is another node's and has no effect here")
            continue
        known = [*foreign, *(known for known in node._parameters if not known.startswith(_QOS))]
        raise ParameterError(f"parameter {name} is unknown", valid=_meant(name, known) or "see --help")


def warn_of_unknown_qos(node: Node) -> None:
    """Log every override of quality of service that is for no topic of the node, once its topics are made."""
    for name in _undeclared(node):
        if name.startswith(_QOS):
            hint = _meant(name, [known for known in node._parameters if known.startswith(_QOS)])
            node.get_logger().warning(
                f"parameter {name} is unknown and has no effect" + (f": {hint}" if hint else "")
            )


def _undeclared(node: Node) -> list[str]:
    # rclpy offers no other way to the parameters given.
    return [name for name in sorted(node._parameter_overrides) if not node.has_parameter(name)]


def _meant(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=2)
    return f"meant is perhaps {' or '.join(close)}" if close else ""
