"""Text, hash and field layout of the message types in a bag.

The texts are the `.msg` files of the interface package, which are package data. The schema of
another bag is compared with them field by field before its messages are decoded.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE, RANGE_CORRECTED_TYPE, RANGE_TRUTH_TYPE

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

PACKAGE = "uwb_mitigation_msgs"
SEPARATOR = "=" * 80
"""Separator of the sections of a `ros2msg` schema (MCAP format registry, "ros2msg")."""

_NESTED = {RANGE_CIR_TYPE: ("Cir",), RANGE_TRUTH_TYPE: (), RANGE_CORRECTED_TYPE: ()}

_OPTIONAL = {(f"{PACKAGE}/Cir", "radio"), (f"{PACKAGE}/Cir", "segment")}
"""Section and name of fields that bags of earlier versions do not contain."""

Layout = dict[str, list[tuple[str, str]]]
"""Fields of a message and of its nested messages: {section: [(type, name), ...]}."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of this project, for the `rosbags` library."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("Cir", "RangeCir", "RangeTruth", "RangeCorrected"):
        store.register(get_types_from_msg(_message_text(name), f"{PACKAGE}/msg/{name}"))
    return store


def serialize(type_name: str, **fields: Any) -> bytes:
    """Return a message in CDR; nested messages are objects with the names of their fields, such as `SimpleNamespace`."""
    return bytes(typestore().serialize_cdr(SimpleNamespace(**fields), type_name))


def deserialize(type_name: str, data: bytes) -> Any:
    """Return a message with its fields as attributes.

    Raises:
        RecordingError: the bytes are not such a message.
    """
    try:
        return typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # Of no common type.
        raise RecordingError(f"a message that is not {type_name}", where=f"{len(data)} bytes") from error


@lru_cache(maxsize=8)
def definition(type_name: str) -> str:
    """Return the `ros2msg` schema of a type of this project or a standard type: its text, then those of all nested types."""
    if type_name not in _NESTED:
        standard, _ = typestore().generate_msgdef(type_name, ros_version=2)
        return standard
    header, _ = typestore().generate_msgdef("std_msgs/msg/Header", ros_version=2)
    sections = [("std_msgs/Header", header)]
    sections += [(f"{PACKAGE}/{name}", _message_text(name)) for name in _NESTED[type_name]]
    text = _message_text(type_name.rpartition("/")[2])
    return text + "".join(f"{SEPARATOR}\nMSG: {name}\n{body}" for name, body in sections)


@lru_cache(maxsize=8)
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type, as computed by ROS 2 (REP-2011)."""
    return typestore().hash_rihs01(type_name)


def difference(schema: str, type_name: str) -> str | None:
    """Return the difference between the fields of a `schema` and those of this project's `type_name`.

    Comments and constants are ignored, because they do not change the layout. None: messages of that
    schema can be decoded.
    """
    sections = _layout(schema)
    for section, fields in _layout(definition(type_name)).items():
        place = section or type_name
        if section not in sections:
            return f"{place} is not defined"
        for number, field in enumerate(fields):
            have = sections[section][number] if number < len(sections[section]) else None
            if have is None and (section, field[1]) in _OPTIONAL:
                continue
            if have != field:
                shown = " ".join(have) if have else "nothing"
                return f"field {number + 1} of {place} is {shown!r}, expected {' '.join(field)!r}"
        if len(sections[section]) > len(fields):
            extra = " ".join(sections[section][len(fields)])
            return f"{place} has an additional field {extra!r}"
    return None


def _message_text(name: str) -> str:
    return (files("uwb_mitigation") / "types" / "ros" / "interfaces" / f"{name}.msg").read_text(
        encoding="utf-8"
    )


def _layout(schema: str) -> Layout:
    """Return sections by name; the root's name is empty, because a schema does not contain it."""
    layout: Layout = {"": []}
    fields = layout[""]
    for line in schema.splitlines():
        words = line.partition("#")[0].split()
        if not words or (len(words) == 1 and set(words[0]) == {"="}):
            continue
        if words[0] == "MSG:":
            fields = layout.setdefault(_full_name(words[-1]), [])
        elif len(words) > 1 and "=" not in words[1] and (len(words) < 3 or not words[2].startswith("=")):
            fields.append((_full_name(words[0]), words[1]))
    return layout


def _full_name(type_name: str) -> str:
    """Return `pkg/Name` for `pkg/msg/Name`, and for `Name` inside the same package."""
    names = [name for name in type_name.split("/") if name != "msg"]
    if len(names) == 1 and names[0][:1].isupper():
        return "std_msgs/Header" if names[0] == "Header" else f"{PACKAGE}/{names[0]}"
    return "/".join(names)
