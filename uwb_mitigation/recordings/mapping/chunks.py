"""Rows of a file or topic: the form in which all readers of tables return them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOG_TIME = "@stamp"
"""Column with the time at which a message was recorded, ns."""

UNREADABLE = (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError, NotImplementedError)
"""Errors of values that do not have the expected form."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Rows of one file.

    Attributes:
        columns: {name: array or list}.
        count: number of rows.
        path: the file, or the topic.
        rows: int64 (count,), numbers of the rows in the file, from 0.
        before: number of rows in the files before.
    """

    columns: Mapping[str, Any]
    count: int
    path: Path | str
    rows: NDArray[np.int64]
    before: int = 0

    def where(self, row: int) -> str:
        """Return the location of a row for errors."""
        return f"{self.path}: row {self.rows[row] + 1}"

    def take(self, mask: NDArray[np.bool_]) -> Chunk:
        """Return the chosen rows."""
        if mask.all():
            return self
        items = self.columns.items()
        columns = {n: v[mask] if isinstance(v, np.ndarray) else [*compress(v, mask)] for n, v in items}
        return Chunk(columns, int(mask.sum()), self.path, self.rows[mask], self.before)
