"""The base of dataclasses whose arrays have one row for each item: select rows, and concatenate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_Table = TypeVar("_Table", bound="Columns")


class Columns:
    """Base of dataclasses of n rows: their arrays are columns (n, ...), and other fields are common to all rows."""

    __slots__ = ()

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by their names."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def take(self: _Table, rows: Any) -> _Table:
        """Return the rows of indices, a mask, or a slice."""
        columns: Any = {name: column[rows] for name, column in self.columns().items()}
        return replace(self, **columns)  # type: ignore[type-var]

    @staticmethod
    def joined(tables: Sequence[_Table]) -> _Table:
        """Concatenate one or more tables of the same columns; other fields are those of the first one."""
        if any(table.columns().keys() != tables[0].columns().keys() for table in tables):
            raise ValueError("the tables have different columns")
        columns: Any = {
            name: np.concatenate([getattr(table, name) for table in tables]) for name in tables[0].columns()
        }
        return replace(tables[0], **columns)  # type: ignore[type-var]
