"""Offsets of radios: file, precedence and effect on a range."""

from pathlib import Path

import numpy as np
import pytest

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.offsets import (
    MAX_ENTRIES,
    MAX_OFFSET_M,
    NO_OFFSETS,
    Offsets,
    dump_offsets,
    parse_offsets,
    read_offsets,
)

TEXT = """\
default: 0.5
anchors: {1: 0.25, 0x1f: 0.125}
tags: {7: -0.0625}
pairs:
  - {anchor: 1, tag: 7, offset: 1.5}
"""


def test_most_specific_offset_applies_and_radio_offsets_add_up():
    offsets = parse_offsets(TEXT, "x")
    assert offsets.lookup([7, 7, 8, 7, 8], [1, 31, 1, 9, 9]).tolist() == [1.5, 0.0625, 0.25, -0.0625, 0.5]
    unknown = np.array([8, 2**64 - 1], np.uint64)
    assert offsets.lookup(unknown, unknown).tolist() == [0.5, 0.5]


def test_written_offsets_are_read_back():
    offsets = parse_offsets(TEXT, "x")
    assert parse_offsets(dump_offsets(offsets, "found\nso"), "y") == offsets
    assert not parse_offsets(dump_offsets(NO_OFFSETS), "y")
    assert offsets


def test_parameter_is_a_number_or_a_file(tmp_path: Path):
    assert read_offsets("") is NO_OFFSETS
    assert read_offsets(" 0.22 ").lookup([1], [2]) == np.float32(0.22)
    path = tmp_path / "offsets.yaml"
    path.write_text(TEXT, encoding="utf-8")
    assert read_offsets(str(path)) == parse_offsets(TEXT, "x")
    with pytest.raises(ParameterError, match=r"none\.yaml: no such file.*metres"):
        read_offsets(str(tmp_path / "none.yaml"))
    path.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(ParameterError, match="not a text file"):
        read_offsets(str(path))


@pytest.mark.parametrize(
    ("text", "excerpt"),
    [
        ("", "not a file of offsets"),
        ("[0.2]", "not a file of offsets"),
        ("{", "not YAML"),
        ("default: yes", "default = True.*metres"),
        ("default: .nan", "default = nan"),
        ("default: 220", "default = 220 m: are these millimetres"),
        ("default: -220", "default = -220 m: are these millimetres"),
        ("default: 1.0e+9", "-10 to 10 m"),
        ("default: '0.2'", "a number of metres"),
        ("offset: 0.2", "unknown key 'offset'.*default, anchors, tags, pairs"),
        ("anchors: [1, 2]", "id: metres"),
        ("anchors: {a: 0.2}", "id 'a'.*64-bit"),
        ("anchors: {-1: 0.2}", "id -1"),
        ("anchors: {18446744073709551616: 0.2}", "id 18446744073709551616"),
        ("tags: {1: .inf}", "tags: 1 = inf"),
        ("anchors: {1: 0.1, 0x1: 0.2}", "duplicate key 1"),
        ("default: 0.1\ndefault: 0.2", "duplicate key 'default' in line 2"),
        ("pairs: {1: 2}", "pairs = "),
        ("pairs: [{anchor: 1, tag: 2}]", "entry 1.*not a pair.*anchor, tag, offset"),
        (
            "pairs: [{anchor: 1, tag: 2, offset: 0.1}, {anchor: 1, tag: 2, offset: 0.2}]",
            "entry 2.*duplicate pair",
        ),
    ],
)
def test_malformed_offsets_file_is_refused(text: str, excerpt: str):
    with pytest.raises(ParameterError, match=excerpt) as caught:
        parse_offsets(text, "site.yaml")
    assert "site.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "excerpt"),
    [
        ({"anchors": dict.fromkeys(range(MAX_ENTRIES), 0.1)}, f"{MAX_ENTRIES + 1} offsets"),
        ({"pair_sd": {(1, 2): 0.0}}, "sd = 0.0 m of anchor 2, tag 1"),
        ({"pair_sd": {(1, 2): MAX_OFFSET_M + 1.0}}, "sd = "),
    ],
)
def test_offsets_out_of_the_limits_are_refused(options: dict, excerpt: str):
    with pytest.raises(ParameterError, match=excerpt):
        Offsets(**{"pairs": {(1, 2): 0.1}} | options)


def test_largest_offsets_and_standard_deviations_are_accepted_and_compared():
    widest = {"pairs": {(1, 2): -MAX_OFFSET_M}, "pair_sd": {(1, 2): MAX_OFFSET_M}}
    offsets = Offsets(MAX_OFFSET_M, dict.fromkeys(range(MAX_ENTRIES - 1), 0.1), **widest)
    assert str(offsets) == f"{MAX_OFFSET_M:g} m, and {MAX_ENTRIES} of anchors, tags and pairs"
    small, large = Offsets(0.1), Offsets(0.2)
    assert small == Offsets(0.1)
    assert small != large
    assert large != small
