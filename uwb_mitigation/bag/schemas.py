"""The text, hash and field layout of the message types in a bag.

The texts are the `.msg` files of the interface package, which this package carries as data; a schema
found in a foreign bag is compared with them field by field before a message of it is decoded.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from uwb_mitigation.bag.topics import RANGE_CIR_TYPE, RANGE_CORRECTED_TYPE, RANGE_TRUTH_TYPE

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

PACKAGE = "uwb_mitigation_msgs"
SEPARATOR = "=" * 80
"""Stands between the sections of a `ros2msg` schema (MCAP format registry, "ros2msg")."""

_NESTED = {
    RANGE_CIR_TYPE: ("Cir",),
    RANGE_TRUTH_TYPE: (),
    RANGE_CORRECTED_TYPE: (),
}

Layout = dict[str, list[tuple[str, str]]]
"""The fields of a message and of every message in it: {section: [(type, name), ...]}."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The types of ROS 2 Jazzy together with ours, for the `rosbags` library."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name in ("Cir", "RangeCir", "RangeTruth", "RangeCorrected"):
        types.update(get_types_from_msg(_message_text(name), f"{PACKAGE}/msg/{name}"))
    store.register(types)
    return store


@lru_cache(maxsize=8)
def definition(type_name: str) -> str:
    """The `ros2msg` schema of one of our types, or of a standard one: its text, then that of every type it uses."""
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
    """The RIHS01 hash that ROS 2 itself computes for a type (REP-2011)."""
    return typestore().hash_rihs01(type_name)


def difference(schema: str, type_name: str) -> str | None:
    """What differs between the fields of a foreign `schema` and those of our `type_name`.

    Comments and constants are left aside: they do not move a byte. None means that messages of that
    schema decode as ours do.
    """
    found = _layout(schema)
    for section, fields in _layout(definition(type_name)).items():
        place = section or type_name
        if section not in found:
            return f"{place} is not defined"
        for number, wanted in enumerate(fields):
            have = found[section][number] if number < len(found[section]) else None
            if have != wanted:
                shown = " ".join(have) if have else "nothing"
                return f"field {number + 1} of {place} is {shown!r}, expected {' '.join(wanted)!r}"
        if len(found[section]) > len(fields):
            extra = " ".join(found[section][len(fields)])
            return f"{place} has a further field {extra!r}"
    return None


def _message_text(name: str) -> str:
    return (files("uwb_mitigation") / "interfaces" / f"{name}.msg").read_text(encoding="utf-8")


def _layout(schema: str) -> Layout:
    """Sections by name; the root's name is empty, since a schema does not state it."""
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
    """`pkg/msg/Name` and, inside our own package, a bare `Name` both become `pkg/Name`."""
    parts = [part for part in type_name.split("/") if part != "msg"]
    if len(parts) == 1 and parts[0][:1].isupper():
        return "std_msgs/Header" if parts[0] == "Header" else f"{PACKAGE}/{parts[0]}"
    return "/".join(parts)
