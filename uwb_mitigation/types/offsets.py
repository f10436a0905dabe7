"""Range offsets of radios, caused by uncalibrated antenna delays and independent of the channel.

    default: 0.15                # m, of pairs without an entry below
    anchors: {1: 0.21, 0x1f: 0.19}
    tags: {7: -0.02}
    pairs:
      - {anchor: 1, tag: 7, offset: 0.22, sd: 0.03}

`sd` is the optional standard deviation in m. If a pair has an entry, this is its offset; otherwise the sum of the offsets of its anchor and tag
(0 for one without an entry), because the delays of two radios add; otherwise the default. A single number is a default.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, check_name, format_id
from uwb_mitigation.files import read_bounded
from uwb_mitigation.types.yaml_text import check_id, check_metres, parse_yaml

MAX_OFFSET_M = 10.0
"""A DW1000 without any antenna delay has an offset of 154 m: set `antenna_delay` in the radio instead."""

MAX_ENTRIES = 10_000
MAX_TEXT = 1 << 20
_SECTIONS = ("default", "anchors", "tags", "pairs")
_PAIR = ("anchor", "tag", "offset")
SCHEMA = (
    "default: m; anchors: {id: m}; tags: {id: m}; pairs: a list of {anchor, tag, offset, and optionally sd}"
)
VALID = f"a number of metres, {-MAX_OFFSET_M:g} to {MAX_OFFSET_M:g}, or a YAML file of offsets by anchor, tag or pair"
_EMPTY: Mapping[Any, float] = MappingProxyType({})


class Offsets:
    """Offsets of pairs of radios, m, rounded to float32 as in messages and on boards; immutable.

    Args:
        default: offset of pairs without an entry.
        anchors: {id: m}.
        tags: {id: m}.
        pairs: {(tag, anchor): m}.
        where: name of the file or parameter in errors.
        pair_sd: standard deviations of some pairs, m.

    Raises:
        ParameterError: an offset is not finite or beyond `MAX_OFFSET_M`, or there are too many.
    """

    def __init__(
        self,
        default: float = 0.0,
        anchors: Mapping[int, float] = _EMPTY,
        tags: Mapping[int, float] = _EMPTY,
        pairs: Mapping[tuple[int, int], float] = _EMPTY,
        where: str = "offsets",
        pair_sd: Mapping[tuple[int, int], float] = _EMPTY,
    ) -> None:
        entries = len(anchors) + len(tags) + len(pairs)
        if entries > MAX_ENTRIES:
            raise ParameterError(f"{entries} offsets", where=where, valid=f"at most {MAX_ENTRIES}")
        self.default = _checked(default, "default", where)
        self.anchors = {i: _checked(value, f"anchor {format_id(i)}", where) for i, value in anchors.items()}
        self.tags = {i: _checked(value, f"tag {format_id(i)}", where) for i, value in tags.items()}
        self.pairs = {
            (tag, anchor): _checked(value, f"anchor {format_id(anchor)}, tag {format_id(tag)}", where)
            for (tag, anchor), value in pairs.items()
        }
        self.pair_sd = {pair: float(pair_sd[pair]) for pair in self.pairs if pair in pair_sd}
        for (tag, anchor), sd in self.pair_sd.items():
            if not 0.0 < sd <= MAX_OFFSET_M:
                what = f"sd = {sd!r:.60} m of anchor {format_id(anchor)}, tag {format_id(tag)}"
                raise ParameterError(what, where=where, valid=f"more than 0, at most {MAX_OFFSET_M:g} m")

    def __eq__(self, value: object) -> bool:
        if not isinstance(value, Offsets):
            return NotImplemented
        first, second = ((item.default, item.anchors, item.tags, item.pairs) for item in (self, value))
        return first == second

    def __hash__(self) -> int:
        return hash((self.default, *(frozenset(o.items()) for o in (self.anchors, self.tags, self.pairs))))

    def __bool__(self) -> bool:
        """Whether any offset is not 0."""
        return any((self.default, *self.anchors.values(), *self.tags.values(), *self.pairs.values()))

    def __len__(self) -> int:
        """Number of entries for anchors, tags and pairs."""
        return len(self.anchors) + len(self.tags) + len(self.pairs)

    def __str__(self) -> str:
        return f"{self.default:g} m" + (f", and {len(self)} of anchors, tags and pairs" if len(self) else "")

    def lookup(
        self, tag_ids: Sequence[int] | NDArray[Any], anchor_ids: Sequence[int] | NDArray[Any]
    ) -> NDArray[np.float32]:
        """Return the offsets of pairs, m: n ids each to float32 (n,)."""
        if not len(self):
            return np.full(len(tag_ids), self.default, np.float32)
        tags, anchors = (np.asarray(ids, np.uint64).tolist() for ids in (tag_ids, anchor_ids))
        return np.array([self._find(pair) for pair in zip(tags, anchors, strict=True)], np.float32)

    def _find(self, pair: tuple[int, int]) -> float:
        if pair in self.pairs:
            return self.pairs[pair]
        tag, anchor = pair
        if tag in self.tags or anchor in self.anchors:
            return float(np.float32(self.anchors.get(anchor, 0.0)) + np.float32(self.tags.get(tag, 0.0)))
        return self.default


def read_offsets(value: str) -> Offsets:
    """Return the offsets of a parameter or option: a number in metres, the path of a file, or empty for 0.

    Raises:
        ParameterError: the text is neither, or the file is not an offsets file.
    """
    text = value.strip()
    if not text:
        return NO_OFFSETS
    try:
        number = float(text)
    except ValueError:
        path = Path(text).expanduser()
        return parse_offsets(read_bounded(path, MAX_TEXT, ParameterError, VALID), str(path))
    return Offsets(number)


AnyOffsets: TypeAlias = "Offsets | float | str | Path | Mapping[str, Any]"
"""What `as_offsets` accepts."""


def as_offsets(value: AnyOffsets) -> Offsets:
    """Return offsets, a number in m for all pairs, the content of a file, or a dictionary with the sections of a file.

    Raises:
        ParameterError: it is something else, see `parse_offsets`.
    """
    if isinstance(value, Offsets):
        return value
    if isinstance(value, Mapping):
        return _from_sections(value, "offsets")
    if isinstance(value, bool) or not isinstance(value, str | Path | Real):
        raise ParameterError(f"offsets = {value!r:.60}", valid=f"{VALID}, or {SCHEMA}")
    return read_offsets(str(value))


def parse_offsets(text: str | bytes, where: str) -> Offsets:
    """Parse the text of an offsets file.

    Args:
        text: YAML (or JSON) in the format of the module docstring, or one number.
        where: name of the file in errors.

    Raises:
        ParameterError: the text is not YAML or has another format; the message names the entry.
    """
    document = parse_yaml(text, where, SCHEMA)
    if isinstance(document, int | float) and not isinstance(document, bool):
        return Offsets(document, where=where)
    if not isinstance(document, dict):
        raise ParameterError("not a file of offsets", where=where, valid=SCHEMA)
    return _from_sections(document, where)


def _from_sections(document: Mapping[Any, Any], where: str) -> Offsets:
    for name in document:
        check_name("key", name, _SECTIONS, where, f"the keys {', '.join(_SECTIONS)}: {SCHEMA}")
    pairs, sd_by_pair = _by_pair(document.get("pairs") or [], where)
    return Offsets(
        _checked(document.get("default", 0.0), "default", where),
        _by_id(document.get("anchors") or {}, "anchors", where),
        _by_id(document.get("tags") or {}, "tags", where),
        pairs,
        where,
        sd_by_pair,
    )


def dump_offsets(offsets: Offsets, comment: str = "") -> str:
    """Return the text of an offsets file for `parse_offsets`; each line of `comment` precedes it."""
    lines = [*(f"# {line}" for line in comment.splitlines()), f"default: {round(offsets.default, 6)}"]
    for name, entries in (("anchors", offsets.anchors), ("tags", offsets.tags)):
        if entries:
            lines += [f"{name}:", *(f"  {format_id(i)}: {round(m, 6)}" for i, m in sorted(entries.items()))]
    if offsets.pairs:
        lines.append("pairs:")
    for (tag, anchor), value in sorted(offsets.pairs.items()):
        sd = offsets.pair_sd.get((tag, anchor))
        entry = f"anchor: {format_id(anchor)}, tag: {format_id(tag)}, offset: {round(value, 6)}"
        lines.append(f"  - {{{entry}{'' if sd is None else f', sd: {round(sd, 6)}'}}}")
    return "\n".join(lines) + "\n"


def _by_id(entries: object, name: str, where: str) -> dict[int, float]:
    if not isinstance(entries, dict):
        raise ParameterError(f"{name} = {entries!r:.60}", where=where, valid=f"{name}: {{id: metres}}")
    return {
        check_id(key, f"{name}: id", where): _checked(value, f"{name}: {key!r:.60}", where)
        for key, value in entries.items()
    }


def _by_pair(
    entries: object, where: str
) -> tuple[dict[tuple[int, int], float], dict[tuple[int, int], float]]:
    """Return offsets and standard deviations by pair."""
    if not isinstance(entries, list):
        raise ParameterError(f"pairs = {entries!r:.60}", where=where, valid=SCHEMA)
    offsets_by_pair: dict[tuple[int, int], float] = {}
    sd_by_pair: dict[tuple[int, int], float] = {}
    for number, entry in enumerate(entries, 1):
        entry_where = f"{where}: pairs, entry {number}"
        for name in entry if isinstance(entry, dict) else ():
            check_name("key", name, (*_PAIR, "sd"), entry_where)
        if not isinstance(entry, dict) or not set(entry) >= set(_PAIR):
            raise ParameterError(
                f"{entry!r:.80} is not a pair", where=entry_where, valid=f"{{{', '.join(_PAIR)}}}"
            )
        tag, anchor = (check_id(entry[kind], f"{kind}: id", entry_where) for kind in ("tag", "anchor"))
        pair = tag, anchor
        if pair in offsets_by_pair:
            raise ParameterError("duplicate pair", where=entry_where, valid="one entry for each pair")
        offsets_by_pair[pair] = _checked(entry["offset"], "offset", entry_where)
        if "sd" in entry:
            sd_by_pair[pair] = _checked(entry["sd"], "sd", entry_where)
    return offsets_by_pair, sd_by_pair


def _checked(value: object, name: str, where: str) -> float:
    return float(np.float32(check_metres(value, name, where, -MAX_OFFSET_M, MAX_OFFSET_M)))


NO_OFFSETS = Offsets()
