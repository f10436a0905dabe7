"""The anchors of a site: their file, and arrays for estimation.

    anchors:
      - {id: 1, x: 0.0, y: 0.0, z: 2.1}
      - {id: 2, x: 7.6, y: 0.0, z: 2.1, sd: 0.05, name: door}

Metres in the frame `map`; `sd`: standard deviation of each coordinate, 0.05 m by default; `id`: the 64-bit id of the
ranges, decimal or 0x... . Other fields are errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, check_name, format_id
from uwb_mitigation.files import read_bounded, write_atomically
from uwb_mitigation.types.yaml_text import check_id, check_metres, parse_yaml

SD_M = 0.05
"""Accuracy of a tape measure."""

MAX_ANCHORS = 256
MAX_TEXT = 1 << 20
MAX_COORDINATE_M = 1e5
MILLIMETRES = 200.0
"""Anchors further apart do not receive each other: such coordinates are probably millimetres."""

_NEEDED = ("id", "x", "y", "z")
_FIELDS = (*_NEEDED, "sd", "name")
SCHEMA = "anchors: a list of {id, x, y, z, and optionally sd, name}, in metres"


@dataclass(frozen=True, slots=True)
class Anchor:
    """An anchor at a known position.

    Attributes:
        id: 64-bit identity.
        position: x, y, z in m.
        sd: standard deviation of each coordinate, m.
        name: display name; may be empty.
    """

    id: int
    position: tuple[float, float, float]
    sd: float = SD_M
    name: str = ""

    def __str__(self) -> str:
        identity = format_id(self.id)
        return f"{identity} ({self.name})" if self.name else identity


class AnchorMap:
    """The anchors of a site; immutable.

    Args:
        anchors: the anchors, or {id: (x, y, z)} in m.
        where: name of the file or parameter in errors.

    Attributes:
        anchors: one or more, with different ids.
        position: float64 (m, 3), m.
        sd: float64 (m,), m.
        index: {id: row}.

    Raises:
        ParameterError: no anchor, too many, an id twice, or a position that is not finite.
    """

    def __init__(
        self, anchors: Sequence[Anchor] | Mapping[int, Sequence[float]], where: str = "anchors"
    ) -> None:
        if isinstance(anchors, Mapping):
            anchors = [_anchor_at(identity, position, where) for identity, position in anchors.items()]
        if not isinstance(anchors, Sequence) or not all(isinstance(anchor, Anchor) for anchor in anchors):
            raise ParameterError(
                f"{anchors!r:.60}", where=where, valid="Anchor objects, or {id: (x, y, z)} in m"
            )
        if not 1 <= len(anchors) <= MAX_ANCHORS:
            raise ParameterError(f"{len(anchors)} anchors", where=where, valid=f"1 to {MAX_ANCHORS}")
        self.anchors = tuple(anchors)
        self.index = {anchor.id: row for row, anchor in enumerate(self.anchors)}
        if len(self.index) < len(self.anchors):
            twice = next(a.id for row, a in enumerate(self.anchors) if self.index[a.id] != row)
            raise ParameterError(
                f"anchor {format_id(twice)} is there twice", where=where, valid="one entry for each"
            )
        try:
            self.position = np.array([anchor.position for anchor in self.anchors], np.float64).reshape(-1, 3)
        except (TypeError, ValueError) as error:
            raise ParameterError(f"a position: {error}", where=where, valid="(x, y, z) in m") from error
        if not np.isfinite(self.position).all():
            raise ParameterError("a position is not finite", where=where, valid="(x, y, z) in m")
        self.sd: NDArray[np.float64] = np.array([anchor.sd for anchor in self.anchors], np.float64)
        self.position.setflags(write=False)
        self.sd.setflags(write=False)

    def __len__(self) -> int:
        return len(self.anchors)

    def moved(self, position: NDArray[np.float64], sd: NDArray[np.float64]) -> AnchorMap:
        """Return the same anchors at other positions: float64 (m, 3) and (m,)."""
        rows = zip(self.anchors, position.tolist(), sd.tolist(), strict=True)
        return AnchorMap([replace(anchor, position=tuple(xyz), sd=sd_m) for anchor, xyz, sd_m in rows])


def parse_anchors(text: str | bytes, where: str) -> AnchorMap:
    """Parse the text of an anchors file, YAML or JSON; `where`: its name in errors.

    Raises:
        ParameterError: it has another format; the message names entry and field.
    """
    if len(text) > MAX_TEXT:
        raise ParameterError(f"{len(text)} characters", where=where, valid=f"{MAX_TEXT} at most")
    document = parse_yaml(text, where, SCHEMA)
    entries = document.get("anchors") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not isinstance(document, dict) or len(document) != 1:
        raise ParameterError("not a list of anchors", where=where, valid=SCHEMA)
    anchors = AnchorMap([_anchor(entry, f"{where}: entry {n}") for n, entry in enumerate(entries, 1)], where)
    spread = np.ptp(anchors.position, axis=0).max() if len(anchors) > 1 else 0.0
    if spread > MILLIMETRES and np.all(anchors.position == np.rint(anchors.position)):
        raise ParameterError(
            f"anchors {spread:g} m apart, all at whole numbers: these look like millimetres",
            where=where,
            valid="metres",
        )
    return anchors


def dump_anchors(anchors: AnchorMap, comment: str = "") -> str:
    """Return the text of an anchors file, after the lines of `comment`."""
    lines = [*(f"# {line}" for line in comment.splitlines()), "anchors:"]
    for anchor in anchors.anchors:
        x, y, z = (round(value, 6) for value in anchor.position)
        entry: dict[str, object] = {"x": x, "y": y, "z": z, "sd": round(anchor.sd, 6)}
        if anchor.name:
            entry["name"] = anchor.name
        fields = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, width=1 << 16)
        lines.append(f"  - {{id: {format_id(anchor.id)}, {fields.removeprefix('{').rstrip()}")
    return "\n".join(lines) + "\n"


def _anchor_at(identity: object, position: Any, where: str) -> Anchor:
    try:
        x, y, z = map(float, position)
    except (TypeError, ValueError) as error:
        what = f"anchor {identity!r:.60} at {position!r:.60}"
        raise ParameterError(what, where=where, valid="{id: (x, y, z)} in m") from error
    return _anchor({"id": identity, "x": x, "y": y, "z": z}, where)


def _anchor(entry: Any, where: str) -> Anchor:
    if not isinstance(entry, dict):
        raise ParameterError(f"{entry!r:.60} is no anchor", where=where, valid=SCHEMA)
    for name in entry:
        check_name("field", name, _FIELDS, where)
    absent = [name for name in _NEEDED if name not in entry]
    if absent:
        raise ParameterError(f"the field {absent[0]} is missing", where=where, valid=", ".join(_FIELDS))
    x, y, z = (check_metres(entry[key], key, where, -MAX_COORDINATE_M, MAX_COORDINATE_M) for key in "xyz")
    sd = check_metres(entry.get("sd", SD_M), "sd", where, 0.0, 100.0)
    name = entry.get("name", "")
    if not isinstance(name, str) or len(name) > 100:
        raise ParameterError(f"name = {name!r:.60}", where=where, valid="text of at most 100 characters")
    return Anchor(check_id(entry["id"], "id =", where), (x, y, z), sd, name)


AnyAnchors: TypeAlias = AnchorMap | Mapping[int, Sequence[float]] | Sequence[Anchor] | str | Path
"""What `as_anchors` accepts."""


def as_anchors(value: AnyAnchors) -> AnchorMap:
    """Return anchors, those of a file, or those of a dictionary {id: (x, y, z)} in m.

    Raises:
        ParameterError: it is something else, see `AnchorMap` and `load_anchors`.
    """
    if isinstance(value, AnchorMap):
        return value
    return load_anchors(value) if isinstance(value, str | Path) else AnchorMap(value)


def anchors_path(bag: Path) -> Path:
    """Return the path of a bag's anchors file: `X.anchors.yaml` in the folder of `X.mcap`."""
    return bag.with_name(bag.name.removesuffix(".mcap") + ".anchors.yaml")


def load_anchors(path: Path | str) -> AnchorMap:
    """Read an anchors file (YAML or JSON): `anchors: [{id: 1, x: 0.0, y: 0.0, z: 2.1, name: door}, ...]`, in metres.

    Raises:
        ParameterError: it cannot be read, or does not have the format of `positioning.anchors`.
    """
    path = Path(path)
    return parse_anchors(read_bounded(path, MAX_TEXT, ParameterError, SCHEMA), str(path))


def save_anchors(path: Path, anchors: AnchorMap, comment: str = "", *, force: bool = False) -> None:
    """Write an anchors file atomically.

    Raises:
        ParameterError: it exists and `force` is not given, or it cannot be written.
    """
    if path.exists() and not force:
        raise ParameterError("exists already", where=path, valid="--force replaces it")
    write_atomically(path, dump_anchors(anchors, comment), ParameterError)
