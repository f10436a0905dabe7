"""Where results go: whole, to where they were asked for, and nowhere else."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest
import typer

from uwb_mitigation.commands import console
from uwb_mitigation.errors import UwbMitigationError


def test_a_result_replaces_the_file_and_leaves_nothing_beside_it(tmp_path: Path):
    target = tmp_path / "out.json"
    target.write_text("old")
    console.write_json(target, {"n": 1})
    assert json.loads(target.read_text()) == {"n": 1}
    assert list(tmp_path.iterdir()) == [target]


def test_a_link_is_followed_and_stays(tmp_path: Path):
    link, target = tmp_path / "link.json", tmp_path / "target.json"
    link.symlink_to(target)
    console.write_json(link, {"n": 1})
    assert link.is_symlink()
    assert json.loads(target.read_text()) == {"n": 1}


def test_a_pipe_is_written_to_and_stays(tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    console.write_json(pipe, {"n": 1})
    reader.join(10)
    assert json.loads(read[0]) == {"n": 1}
    assert pipe.is_fifo()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path):
    with pytest.raises(UwbMitigationError, match="absent"):
        console.write_json(tmp_path / "absent" / "out.json", {})


@pytest.mark.parametrize("place", ["/", ".", "absent/out.json"])
def test_a_place_that_can_hold_no_result_is_refused_before_the_work(place: str):
    with pytest.raises(typer.BadParameter):
        console._check_json_target(Path(place))
