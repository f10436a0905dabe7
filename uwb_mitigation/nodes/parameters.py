"""The declarative parameter tables of the nodes: name, type, default, range and meaning in one place.

A table declares the parameters on a node, checks every value at start-up and at set time, and names
parameter, value and range in the refusal.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
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

_QOS = "qos_overrides."

Value = bool | int | float | str

_TYPE_NAMES = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of a table.

    Attributes:
        name, default: as declared; the default's type is the parameter's type.
        description: what it does.
        unit: of a number; empty = none.
        low, high: inclusive range of a number.
        choices: the values a string may take; empty = any.
        live: may be set while the node runs; otherwise it is read-only after start-up.
    """

    name: str
    default: Value
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    unit: str = ""

    @property
    def valid(self) -> str:
        """The range of valid values in words."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.low is not None and self.high is not None:
            low, high = (f"{bound:.10g}" for bound in (self.low, self.high))
            return f"{_TYPE_NAMES[type(self.default)]}, {low} to {high} {self.unit}".rstrip()
        return _TYPE_NAMES[type(self.default)]

    def check(self, value: Any) -> None:
        """Raise ParameterError unless `value` has the right type and lies in the range."""
        numeric = isinstance(self.default, float) and type(value) is int
        if type(value) is not type(self.default) and not numeric:
            raise ParameterError(f"parameter {self.name} = {value!r}", valid=self.valid)
        inside = True
        if self.choices:
            inside = value in self.choices
        elif self.low is not None and self.high is not None:
            inside = self.low <= value <= self.high
        if not inside:
            raise ParameterError(f"parameter {self.name} = {value!r}", valid=self.valid)

    def descriptor(self) -> ParameterDescriptor:
        # The type is left open to rclpy and checked here: it would refuse `2` for a float, and names
        # no parameter when it refuses a type.
        descriptor = ParameterDescriptor(
            description=self.description,
            read_only=not self.live,
            dynamic_typing=True,
        )
        descriptor.additional_constraints = self.valid if self.choices else ""
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                span = FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
                descriptor.floating_point_range = [span]
            elif isinstance(self.default, int) and not isinstance(self.default, bool):
                bounds = IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)
                descriptor.integer_range = [bounds]
        return descriptor


def declare(node: Node, table: Sequence[Parameter], foreign: Collection[str] = ()) -> None:
    """Declare a table on a node, warn of parameters that it does not know, and guard later changes.

    Args:
        foreign: names that belong to another node of this process.

    Raises:
        ParameterError: a value given at start-up has the wrong type or lies out of its range.
    """
    rows = {row.name: row for row in table}
    for row in table:
        try:
            node.declare_parameter(row.name, row.default, row.descriptor())
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"parameter {row.name}: {error}", valid=row.valid) from error
        row.check(node.get_parameter(row.name).value)
    warn_of_unknown(node, foreign)

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


def warn_of_unknown(node: Node, foreign: Collection[str] = (), *, qos: bool = False) -> None:
    """Log every parameter that was given at start-up but is not declared, with the names it may have meant.

    Args:
        foreign: names that are no mistake.
        qos: look at the overrides of quality of service, which are declared with their publisher or
            subscription, instead of all others.
    """
    # rclpy offers no other way to the parameters given.
    for name in sorted(node._parameter_overrides):
        if name.startswith(_QOS) is not qos or node.has_parameter(name) or name in foreign:
            continue
        known = [known for known in node._parameters if known.startswith(_QOS) is qos]
        meant = " or ".join(difflib.get_close_matches(name, known, n=2))
        hint = f": meant is perhaps {meant}" if meant else ""
        node.get_logger().warning(f"parameter {name} is unknown and has no effect{hint}")
