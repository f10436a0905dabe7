"""Values of mapped columns in messages: ROS messages of any type, JSON, and lines of text such as `AT+RANGE=...`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from uwb_mitigation.errors import RecordingError, did_you_mean
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, TableFormat
from uwb_mitigation.types.stamps import NS_PER_S

MAX_ROWS = 4096
"""Largest number of ranges in one message."""

MAX_TEXT = 1 << 20
_Columns = dict[str, list[Any]]
_COMMAND = re.compile(r"^\s*AT\+\w+[=:]")
# The boundary keeps the search linear in a long word.
_PAIRS = re.compile(r"\b(\w+)\s*[:=]\s*(\([^()]*\)|\[[^\[\]]*\]|[^,\s()\[\]]+)")


class MessageRows:
    """Reads the columns of a table from messages; a path with `[]` gives a row for each element, also of lists in lists.

    Args:
        table: the mapping; with `pattern` or `text` it describes lines of text.
        columns: {path of a field, such as `nodes[].dis`: whether it is left out if a message does not contain it; None: until a
            message contains it, because a line that is cut must not be read as one of earlier firmware}.
    """

    def __init__(self, table: TableFormat, columns: Mapping[str, bool | None]) -> None:
        self._table, self._columns = table, dict(columns)
        self._pattern = re.compile(table.pattern) if table.pattern else None
        paths = {column: f"{table.group}.{column}" for column in columns if column != LIST_INDEX}
        steps = {column: re.split(r"\.|(\[\])", path) for column, path in paths.items()}
        self._paths = {column: [*filter(None, path)] for column, path in steps.items()}

    def rows(self, message: Any, limit: int = MAX_ROWS) -> _Columns:
        """Return {column: list} of the rows of a message; all have the same length.

        Args:
            message: a message, document, or line of text; the text of a message is in its field `data`.
            limit: largest number of rows.

        Raises:
            RecordingError: a field is missing, or a text is not in the format of the mapping.
        """
        items = self._parsed(message) if self._table.text or self._pattern else [message]
        rows: _Columns = {name: [] for name in (LIST_INDEX, *self._paths)}
        for item in items:
            values: dict[str, tuple[Any, int]] = {}
            for column, path in self._paths.items():
                may_be_missing = self._columns[column]
                try:
                    values[column] = _walk(item, path, column), path.count("[]")
                    if may_be_missing is None:
                        self._columns[column] = False
                except RecordingError:
                    is_there = may_be_missing is None and isinstance(item, dict) and path[0] in item
                    if may_be_missing is False or is_there:
                        raise
                    values[column] = None, 0
            _append_rows(rows, values, 0, limit)
        return rows

    def _parsed(self, message: Any) -> list[Any]:
        """Return the matches of the pattern, or the JSON object or pairs of a text."""
        text = message if isinstance(message, str) else _step(message, "data", "data")
        if not isinstance(text, str) or len(text) > MAX_TEXT:
            raise RecordingError("data is not a text", valid="a field of type string")
        if self._pattern:
            return [match.groupdict() for match in self._pattern.finditer(text)]
        if self._table.text == "json":
            try:
                return [json.loads(text)]
            except (ValueError, RecursionError) as error:
                raise RecordingError(f"not JSON: {text!r:.60}") from error
        return [{name: _items(value) for name, value in _PAIRS.findall(_COMMAND.sub("", text))}]


def _append_rows(rows: _Columns, values: dict[str, tuple[Any, int]], index: int, limit: int) -> None:
    """Append one row for each element of the innermost lists; `values`: (value, depth of its lists)."""
    lists = [value for value, depth in values.values() if depth]
    if not lists:
        if len(rows[LIST_INDEX]) >= limit:
            raise RecordingError(f"more than {limit} ranges in one message", valid=f"at most {limit}")
        rows[LIST_INDEX].append(index)
        for name, (value, _) in values.items():
            rows[name].append(value)
    for number in range(min(map(len, lists), default=0)):
        items = ((name, value[number] if depth else value, depth) for name, (value, depth) in values.items())
        _append_rows(rows, {name: (item, max(depth - 1, 0)) for name, item, depth in items}, number, limit)


def _items(text: str) -> Any:
    """Return the list in brackets, or the text itself."""
    return [item.strip() for item in text[1:-1].split(",")] if text[0] in "([" else text


def _walk(value: Any, path: list[str], column: str) -> Any:
    for number, step in enumerate(path):
        if step == "[]":
            value = list(value.values()) if isinstance(value, dict) else value
            if isinstance(value, str) or not hasattr(value, "__len__"):
                raise RecordingError(f"{column} is not a list")
            return [_walk(item, path[number + 1 :], column) for item in value]
        value = _step(value, step, column)
    seconds = getattr(value, "sec", getattr(value, "secs", None))
    if seconds is not None:
        nanoseconds = getattr(value, "nanosec", getattr(value, "nsecs", 0))
        return int(seconds) * NS_PER_S + int(nanoseconds)
    return value


def _step(value: Any, name: str, column: str) -> Any:
    if isinstance(value, dict):
        if name in value:
            return value[name]
        fields = [str(key) for key in value]
    elif isinstance(value, list | tuple) and name.isdigit() and int(name) < len(value):
        return value[int(name)]
    else:
        if not name.startswith("_") and hasattr(value, name):
            return getattr(value, name)
        names = getattr(value, "__slots__", ()) or vars(type(value)).get("__dataclass_fields__", ())
        fields = [str(field).lstrip("_") for field in names if field != "__msgtype__"]
    what = f"no field {name} for column {column}"
    valid = f"the message has {', '.join(fields[:30]) or 'no fields'}"
    raise RecordingError(what, valid=valid, suggestion=did_you_mean(name, fields))
