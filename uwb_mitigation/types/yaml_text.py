"""YAML and JSON that users write: anchors, offsets, mappings; checks of the values in it."""

from __future__ import annotations

from numbers import Real
from typing import Any

import yaml

from uwb_mitigation.errors import ParameterError


def parse_yaml(text: str | bytes, where: str, valid: str = "") -> Any:
    """Return the content of a YAML or JSON text without duplicate keys; bytes are UTF-8 or UTF-16.

    Args:
        text: the text.
        where: name of its file in errors.
        valid: text for `valid` of errors.

    Raises:
        ParameterError: it is no text, or not YAML.
    """
    try:
        return yaml.load(text, _UniqueKeyLoader)
    except yaml.reader.ReaderError as error:
        raise ParameterError("not a text file", where=where, valid=valid) from error
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ParameterError(f"not YAML: {first}", where=where, valid=valid) from error


def check_id(value: object, what: str, where: str) -> int:
    """Return a 64-bit id; raise ParameterError for another value."""
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 64:
        return value
    raise ParameterError(
        f"{what} {value!r:.60}", where=where, valid="an unsigned 64-bit integer, such as 3 or 0x1f"
    )


def check_metres(value: object, name: str, where: str, low: float, high: float) -> float:
    """Return a number of metres; raise ParameterError for another value, or one out of its limits."""
    if isinstance(value, bool) or not isinstance(value, int | Real):
        raise ParameterError(f"{name} = {value!r:.60}", where=where, valid="a number of metres")
    # No float is as large as some whole numbers.
    metres = value if isinstance(value, int) else float(value)
    if low <= metres <= high:
        return float(metres)
    hint = ": are these millimetres?" if 1000.0 * low <= metres <= 1000.0 * high else ""
    raise ParameterError(f"{name} = {value!r:.60} m{hint}", where=where, valid=f"{low:g} to {high:g} m")


class _UniqueKeyLoader(yaml.SafeLoader):
    """Rejects duplicate keys, of which YAML would keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key_node, _ in node.value:
            # Keys of a mapping that is merged with `<<` may be replaced.
            is_merge = key_node.tag == "tag:yaml.org,2002:merge"
            key = None if is_merge else self.construct_object(key_node, deep=True)
            if isinstance(key, int | float | str) and key in keys:
                raise yaml.YAMLError(f"duplicate key {key!r} in line {key_node.start_mark.line + 1}")
            if isinstance(key, int | float | str):
                keys.add(key)
        return super().construct_mapping(node, deep)
