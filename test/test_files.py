"""Reading files up to a maximum size, and atomic writing."""

import os
import threading
from pathlib import Path

import pytest

from uwb_mitigation.errors import ModelError
from uwb_mitigation.files import partial_path, read_bounded, write_all_atomically, write_atomically


@pytest.mark.parametrize(
    ("name", "excerpt"), [("absent", "no such file"), (".", "no such file"), ("empty", "empty")]
)
def test_missing_or_empty_file_is_refused_with_its_name(tmp_path: Path, name: str, excerpt: str) -> None:
    (tmp_path / "empty").touch()
    with pytest.raises(ModelError, match=rf"{excerpt}.*\(a model\)") as caught:
        read_bounded(tmp_path / name, 10, ModelError, "a model")
    assert caught.value.where == str(tmp_path / name)


def test_symbolic_link_is_followed_and_kept(tmp_path: Path) -> None:
    link, target = tmp_path / "link", tmp_path / "target"
    link.symlink_to(target)
    write_atomically(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"


def test_pipe_is_written_to_and_kept(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    write_atomically(pipe, "new")
    reader.join(240)
    assert read == ["new"]
    assert pipe.is_fifo()


def test_full_disk_keeps_the_old_file_and_leaves_no_partial_file(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    path = tmp_path / "file"
    path.write_text("old")
    partial_path(tmp_path / f"file.{os.getpid()}").symlink_to("/dev/full")
    with pytest.raises(ModelError, match="No space left"):
        write_atomically(path, "new", ModelError)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("unwritable", ["absent/file", "link"])
def test_files_that_belong_together_are_written_atomically(tmp_path: Path, unwritable: str, order: int):
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_text("old")
    link.symlink_to(link)
    pair = {path: "new", tmp_path / unwritable: b"new"}
    with pytest.raises(ModelError, match="cannot be written") as caught:
        write_all_atomically(dict(list(pair.items())[::order]), ModelError)
    assert caught.value.where == str(tmp_path / unwritable)
    assert path.read_text() == "old"
    assert set(tmp_path.iterdir()) == {path, link}
    write_all_atomically({path: "new", tmp_path / "other": b"new"})
    assert [one.read_text() for one in (path, tmp_path / "other")] == ["new", "new"]
