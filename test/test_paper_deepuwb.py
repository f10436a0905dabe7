"""DeepUWB: download, reader and simulated stand-in."""

import functools
import hashlib
import json
import os
import pickle
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import run, start, succeed
from model_material import dataset

from benchmarks.paper import data as experiment_data
from benchmarks.paper import published, rooms
from benchmarks.paper.download import fetch_deepuwb
from benchmarks.paper.environments import OBSTACLES as SIMULATED_OBSTACLES
from benchmarks.paper.environments import ROOMS as SIMULATED_ROOMS
from benchmarks.paper.simulated import SimulatedDeepUwb
from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.training.data import deepuwb
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.deepuwb import NOMINAL_RANGE_M, DeepUwbRecording
from uwb_mitigation.types.measurement import Record

OBSTACLES = ("0000000000", "1000000000", "0000001001", "0000000001")


@pytest.fixture(autouse=True)
def strings_of_python() -> Iterator[None]:
    """Store strings as the published frame does; with pyarrow installed, pandas uses its own ones."""
    with pd.option_context("mode.string_storage", "python"):
        yield


def frame(count: int = 12) -> pd.DataFrame:
    """Return a frame with the published columns and random values."""
    generator = np.random.default_rng(5)
    amplitudes = generator.random((count, 157))
    amplitudes /= amplitudes.max(axis=1, keepdims=True)
    return pd.DataFrame(
        {
            "CIR": [row.copy() for row in amplitudes],
            "Error": generator.normal(0.1, 0.5, count),
            "Room": np.arange(count) % 5,
            "Obstacles": [OBSTACLES[row % 4] for row in range(count)],
        }
    )


def written(folder: Path, data: pd.DataFrame) -> Path:
    data.to_pickle(folder / "dataset.pkl", protocol=4)
    return folder / "dataset.pkl"


def amplitudes_of(records: list[Record]) -> np.ndarray:
    return np.array([record.measurement.cir.samples * record.measurement.cir.scale for record in records])


@pytest.mark.parametrize(
    "writing",
    [
        lambda data: data,
        lambda data: data.assign(CIR=[row.astype(np.float32) for row in data["CIR"]]),
        lambda data: data.assign(CIR=[np.repeat(row, 2)[::2] for row in data["CIR"]]),
        lambda data: data.assign(CIR=[row.tolist() for row in data["CIR"]]),
        lambda data: data.assign(CIR=[tuple(row) for row in data["CIR"]]),
        lambda data: data.assign(CIR=[row.astype(object) for row in data["CIR"]]),
        lambda data: data.astype(object),
        lambda data: data.astype({"Room": "category", "Obstacles": "category"}),
        lambda data: data.astype({"Obstacles": pd.StringDtype("python"), "Room": float}),
        lambda data: data[["Obstacles", "Room", "Error", "CIR"]].assign(Note="x", When=3.5),
        lambda data: data.set_index(pd.Index([f"r{i}" for i in range(len(data))])),
    ],
)
def test_every_kind_of_frame_is_read(tmp_path: Path, writing: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
    data = frame()
    records = list(DeepUwbRecording(written(tmp_path, writing(data))))
    assert np.allclose(amplitudes_of(records), np.stack(list(data["CIR"])), atol=2e-5)
    errors = [record.measurement.range_m - NOMINAL_RANGE_M for record in records]
    assert np.allclose(errors, data["Error"], rtol=1e-6)
    names = [deepuwb.configuration_of(*row) for row in zip(data["Room"], data["Obstacles"], strict=True)]
    assert [record.truth.configuration for record in records if record.truth] == names


@pytest.mark.parametrize("version", ["0.25.3", "1.1.5", "1.5.3", "2.2.3"])
def test_frames_of_older_pandas_are_read(version: str) -> None:
    records = list(DeepUwbRecording(Path(__file__).parent / "data" / f"deepuwb_pandas_{version}.pkl"))
    expected = [np.arange(157) * (row + 1) % 157 / 156 for row in range(4)]
    assert np.allclose(amplitudes_of(records), expected, atol=2e-5)
    assert [record.measurement.range_m - 10.0 for record in records] == [0.25, -0.125, 1.5, 0.0]
    assert [room(record) for record in records] == [0, 2, 4, 2]


def test_errors_survive_import_into_a_bag_to_a_micrometre(tmp_path: Path) -> None:
    errors = [-9.9, -1.234567, 1e-4, 5.999999, 21.9]
    written(tmp_path, frame(5).assign(Error=errors))
    succeed("data", "import", "dataset.pkl", "-o", "bag.mcap", folder=tmp_path)
    found = [each.measurement.range_m - each.truth.range_m for each in McapRecording(tmp_path / "bag.mcap")]
    assert found == pytest.approx(errors, abs=1e-6)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("CIR", np.zeros(156)),
        ("CIR", np.zeros((157, 1))),
        ("CIR", None),
        ("CIR", np.array([0.5] * 100 + [np.nan] * 57)),
        ("Error", 1e6),
        ("Error", "0.3"),
        ("Room", 5),
        ("Room", "big"),
        ("Obstacles", "0000000002"),
        ("Obstacles", "000000000\n"),
        ("Obstacles", "٠٠٠٠٠٠٠٠٠٠"),
        ("Obstacles", 1000000000),
    ],
)
def test_invalid_cell_is_rejected_with_row_and_column(tmp_path: Path, column: str, value: object) -> None:
    data = frame()
    cells = list(data[column])
    cells[7] = value
    data[column] = pd.Series(cells, dtype=object)
    path = written(tmp_path, data)
    with pytest.raises(RecordingError) as caught:
        DeepUwbRecording(path)
    assert caught.value.where == f"{path}, row 7"
    assert caught.value.what.startswith(column)


class Calls:
    """A hostile pickle: unpickling calls a function."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_hostile_pickle_runs_nothing(tmp_path: Path, protocol: int) -> None:
    mark, path = tmp_path / "ran", tmp_path / "dataset.pkl"
    data = frame().astype(object)
    for hostile in (Calls(os.system, f"touch '{mark}'"), Calls(eval, f"open({str(mark)!r}, 'w')")):
        data.at[2, "CIR"] = hostile
        path.write_bytes(pickle.dumps(data, protocol=protocol))
        with pytest.raises(RecordingError):
            DeepUwbRecording(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(frame())[:500],
        b"\x80\x04nonsense",
        b"",
        pickle.dumps(frame()["CIR"]),
        pickle.dumps({"CIR": [1]}),
        pickle.dumps(frame().drop(columns="Room")),
        pickle.dumps(frame().iloc[:0]),
    ],
)
def test_other_files_are_rejected_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "dataset.pkl"
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        DeepUwbRecording(path)
    assert caught.value.where == str(path)


def named(names: np.ndarray) -> Dataset:
    """Return a dataset whose measurements have these configurations."""
    return replace(dataset(1, len(names), samples=4), configurations=names)


def test_split_of_deepuwb_has_the_published_sizes() -> None:
    names = np.repeat([deepuwb.configuration_of(room, OBSTACLES[0]) for room in range(5)], rooms.ROOM_ROWS)
    parts = experiment_data.split_dataset("deepuwb", named(names))
    assert (parts.split, len(parts.train), len(parts.test)) == ("paper", 36_023, 13_210)
    trained, tested = ({name.split("/")[1] for name in part.names} for part in (parts.train, parts.test))
    assert (trained, tested) == ({"room1", "room3"}, {"room2"})


def test_other_data_is_split_by_configuration() -> None:
    parts = experiment_data.split_dataset("logs", named(np.repeat([f"place {n}" for n in range(8)], 3)))
    assert parts.split.startswith("configurations")
    assert len(parts.test) == 6
    assert not set(parts.train.names) & set(parts.test.names)
    with pytest.raises(DatasetError):
        experiment_data.split_dataset("deepuwb", named(np.array(["deepuwb/room1/clear"] * 3)))


def room(record: Record) -> int:
    return rooms.parse_configuration(record.truth.configuration)[0]


def test_simulated_rooms_and_obstacles_are_those_of_deepuwb() -> None:
    assert tuple(one.name for one in SIMULATED_ROOMS) == deepuwb.ROOMS
    assert tuple(one.name for one in SIMULATED_OBSTACLES) == deepuwb.MATERIALS
    assert SimulatedDeepUwb().rows == rooms.ROOM_ROWS
    source = SimulatedDeepUwb(seed=3, ranges=900, exchanges=4)
    records = list(source)
    assert np.bincount([room(record) for record in records]).tolist() == list(source.rows)
    names = np.array([record.truth.configuration for record in records])
    assert all("simulated" in name for name in names)
    assert rooms.has_rooms(names)
    assert not rooms.has_rooms([*names, "simulated survey seed 1/placement 3"])


def test_raw_errors_of_the_simulated_medium_room_have_the_published_mae_and_deviation() -> None:
    source = SimulatedDeepUwb(seed=1, ranges=8_000, exchanges=1)
    errors = np.array([each.measurement.range_m - each.truth.range_m for each in source if room(each) == 2])
    assert np.abs(errors).mean() == pytest.approx(published.RAW_MAE_M, rel=0.1)
    assert errors.std() == pytest.approx(published.RAW_SIGMA_M, rel=0.1)


def test_command_simulates_a_bag_that_can_be_played(tmp_path: Path) -> None:
    words = ("paper", "simulate", "--ranges", "100", "-o", "sim.mcap", "--json", "sim.json")
    succeed(*words, folder=tmp_path)
    assert json.loads((tmp_path / "sim.json").read_text())["ranges"] == 100
    recording = McapRecording(tmp_path / "sim.mcap")
    stamps = [record.measurement.stamp_ns for record in recording]
    assert recording.simulated
    assert stamps[0] > 1_700_000_000 * 10**9
    assert max(np.diff(stamps)) <= 5 * 10**9
    assert run(*words, folder=tmp_path).returncode == 2  # without --force
    assert run("paper", "simulate", "--ranges", "7", "-o", "x.mcap", folder=tmp_path).returncode == 2
    assert not (tmp_path / "x.mcap").exists()


CONTENT = bytes(range(256)) * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Commands write to the stderr of this process, which the test reads."""


@pytest.fixture
def mirror(tmp_path: Path) -> Iterator[str]:
    """The address of a mirror's folder."""
    folder = tmp_path / "mirror"
    folder.mkdir()
    (folder / "dataset.pkl").write_bytes(CONTENT)
    handler = functools.partial(Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{running.server_address[1]}"
        running.shutdown()
        thread.join()


def test_command_downloads_or_fails_with_one_line(mirror: str, tmp_path: Path) -> None:
    words = ("--url", f"{mirror}/dataset.pkl", "--sha256", SHA256, "--json", "fetch.json")
    done = start("paper", "fetch", *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "deepuwb.pkl").read_bytes() == CONTENT
    assert json.loads((tmp_path / "fetch.json").read_text())["bytes"] == len(CONTENT)
    # A file with the right checksum is not loaded again.
    fetch_deepuwb(tmp_path / "deepuwb.pkl", f"{mirror}/absent", SHA256.upper())
    for url, checksum in (
        (f"{mirror}/dataset.pkl", "0" * 64),
        (f"{mirror}/absent", SHA256),
        ("file:///etc/passwd", SHA256),
        ("nonsense", SHA256),
    ):
        done = run("paper", "fetch", "-o", "x.pkl", "--url", url, "--sha256", checksum, folder=tmp_path)
        assert done.returncode == 1
        assert len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "x.pkl").exists()
