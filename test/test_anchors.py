"""The anchors file: content and errors."""

import numpy as np
import pytest

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.anchors import MAX_ANCHORS, MAX_TEXT, Anchor, AnchorMap, dump_anchors, parse_anchors

GOOD = """
anchors:
  - {id: 1, x: 0, y: 0.5, z: 2.1}
  - {id: 0x1f, x: 7.6, y: 0, z: 2.1, sd: 0.02, name: door}
"""


def listed(*positions: tuple[int, float]) -> str:
    """Return a file with an anchor for each id and x."""
    return f"anchors: [{', '.join(f'{{id: {number}, x: {x}, y: 0, z: 0}}' for number, x in positions)}]"


def test_ids_positions_standard_deviations_and_names_are_read():
    anchors = parse_anchors(GOOD, "a.yaml")
    assert [anchor.id for anchor in anchors.anchors] == [1, 31]
    np.testing.assert_array_equal(anchors.position, [[0, 0.5, 2.1], [7.6, 0, 2.1]])
    np.testing.assert_array_equal(anchors.sd, [0.05, 0.02])
    assert [str(anchor) for anchor in anchors.anchors] == ["1", "31 (door)"]


def test_written_file_is_read_back():
    anchors = AnchorMap(
        [Anchor(2**64 - 1, (1.5, -2.0, 0.0), 0.1, "no: 1, 'east'"), Anchor(3, (0.0, 0.0, 1.0))]
    )
    text = dump_anchors(anchors, "two lines\nof comment")
    assert text.startswith("# two lines\n# of comment\n")
    assert parse_anchors(text, "x").anchors == anchors.anchors


def test_large_sites_are_accepted():
    # Positions in millimetres are whole numbers.
    assert len(parse_anchors(listed(*((n, n + 0.25) for n in range(MAX_ANCHORS))), "x")) == MAX_ANCHORS


@pytest.mark.parametrize(
    ("text", "excerpt"),
    [
        ("", "not a list of anchors"),
        ("anchors: []", "0 anchors"),
        (listed(*((n, n / 2) for n in range(MAX_ANCHORS + 1))), "257 anchors"),
        (f"{listed((1, 0))}\nrooms: []", "not a list of anchors"),
        ("[" * 600, "not YAML"),
        ("anchors: [{id: 1, x: 0, x: 1, y: 0, z: 0}]", "duplicate key 'x'"),
        ("#" * (MAX_TEXT + 1), "characters"),
        ("anchors: [3]", "entry 1: 3 is no anchor"),
        ("anchors: [{id: 1, x: 0, y: 0}]", "entry 1: the field z is missing"),
        ("anchors: [{id: 1, x: 0, y: 0, z: 0, colour: red}]", "unknown field 'colour'"),
        ("anchors: [{id: -1, x: 0, y: 0, z: 0}]", "id = -1"),
        ("anchors: [{id: '1', x: 0, y: 0, z: 0}]", "id = '1'"),
        ("anchors: [{id: 1, x: .nan, y: 0, z: 0}]", "x = nan"),
        (f"anchors: [{{id: 1, x: 1{'0' * 400}, y: 0, z: 0}}]", "x = 1000"),
        ("anchors: [{id: 1, x: 0, y: 0, z: 0, sd: -1}]", "sd = -1"),
        ("anchors: [{id: 1, x: 0, y: 0, z: 0, sd: -500.0}]", "sd = -500.0 m (0 to 100 m)"),
        (listed((3, 0), (1, 1), (1, 2)), "anchor 1 is there twice"),
        ("anchors: [{id: 1, x: 0, y: 0, z: 2100}, {id: 2, x: 7600, y: 0, z: 2100}]", "look like millimetres"),
        ("anchors: [{id: 1, x: 3000000, y: 0, z: 0}]", "millimetres?"),
    ],
)
def test_malformed_file_is_refused(text: str, excerpt: str):
    with pytest.raises(ParameterError) as caught:
        parse_anchors(text, "a.yaml")
    assert excerpt in str(caught.value)
    assert str(caught.value).startswith("a.yaml")
