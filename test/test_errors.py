"""Errors for unknown names, which suggest a similar name and list the valid ones; ids as text."""

import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from benchmarks.paper.experiment import Task
from uwb_mitigation.errors import UwbMitigationError, format_id
from uwb_mitigation.mitigation.model.shipped import model_path
from uwb_mitigation.nodes.support import launching
from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.recordings.bag.pose_paths import check_topic
from uwb_mitigation.recordings.mapping.mapping import load_mapping
from uwb_mitigation.types.anchors import parse_anchors
from uwb_mitigation.types.offsets import parse_offsets
from uwb_mitigation.types.ros.poses import tag_frame, tag_of_frame


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (partial(model_path, "Universl"), "universal"),
        (partial(load_mapping, "starlok"), "starloc"),
        (partial(launching.check_names, ["raet:=1"], ["rate", "seed"]), "rate"),
        (partial(DRIVER[0].check, "decarangin"), "decaranging"),
        (partial(parse_offsets, "ancors: {1: 0.2}", "file"), "anchors"),
        (partial(parse_offsets, "pairs: [{anchor: 1, tagg: 2, offset: 0}]", "file"), "tag"),
        (partial(parse_anchors, "anchors: [{id: 1, x: 0, y: 0, z: 0, nmae: A}]", "file"), "name"),
        (partial(Task, "remnt", 157, 1), "remnet"),
        (partial(check_topic, Path("bag"), {"/odom": "A", "/odo": "B"}, "/odon", ("A",)), "/odom"),
    ],
)
def test_unknown_name_is_refused_with_a_suggestion(call: Callable[[], object], name: str):
    with pytest.raises(UwbMitigationError) as caught:
        call()
    assert caught.value.suggestion.startswith(f"did you mean {name!r}")
    assert caught.value.valid
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize("number", [0, 7, 65535, 65536, 2**64 - 1])
def test_id_text_is_complete_and_parsed_back(number: int):
    assert int(format_id(number), 0) == number
    assert len(format_id(number)) == (18 if number > 65535 else len(str(number)))
    frames = f"left/{tag_frame(number)}", "uwb_tag", "tag_", "tag_x", "base_link"
    assert [tag_of_frame(frame) for frame in frames] == [number, *[None] * 4]
