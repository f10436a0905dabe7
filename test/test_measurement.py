"""Measurements: constants, ids and sources."""

from __future__ import annotations

import pytest

from uwb_mitigation.errors import format_id
from uwb_mitigation.types.measurement import CorrectedBy, Encoding, Status
from uwb_mitigation.types.ros.poses import tag_frame, tag_of_frame


def test_constants_equal_those_of_the_messages():
    assert [status.value for status in Status] == [0, 1, 2, 3, 4, 5]
    assert (CorrectedBy.HOST, CorrectedBy.DEVICE) == (0, 1)
    assert (Encoding.COMPLEX_INT16, Encoding.MAGNITUDE) == (0, 1)


@pytest.mark.parametrize("number", [0, 7, 65535, 65536, 2**64 - 1])
def test_id_text_is_complete_and_parsed_back(number: int):
    assert int(format_id(number), 0) == number
    assert len(format_id(number)) == (18 if number > 65535 else len(str(number)))
    assert tag_of_frame(f"left/{tag_frame(number)}") == number


def test_frame_of_no_tag_is_none():
    assert [tag_of_frame(frame) for frame in ("uwb_tag", "tag_", "tag_x", "base_link")] == [None] * 4
