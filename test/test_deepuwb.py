"""DeepUWB's pickle: what is read of it, what each row becomes, and what is refused without being run."""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import requests

from uwb_mitigation.bag.reader import BagReader
from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.dataset import build_dataset
from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.measurement import Encoding
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.sources import deepuwb
from uwb_mitigation.sources.deepuwb import (
    NOMINAL_RANGE_M,
    DeepUwbRecording,
    RoomSplit,
    materials_of,
    room_of,
    split_rows,
)
from uwb_mitigation.sources.opening import open_recording

read_deepuwb = partial(deepuwb.read_deepuwb, trust=True)
recording_of = partial(DeepUwbRecording, trust=True)

OBSTACLES = ("0000000000", "1000000000", "0000001001", "0000000001")


def frame(count: int = 12) -> pd.DataFrame:
    """A frame as the data's description has it; its values are drawn."""
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


def written(path: Path, data: pd.DataFrame, protocol: int = 4) -> Path:
    data.to_pickle(path / "dataset.pkl", protocol=protocol)
    return path / "dataset.pkl"


def with_cell(column: str, row: int, value: object) -> pd.DataFrame:
    data = frame()
    cells = list(data[column])
    cells[row] = value
    data[column] = pd.Series(cells, dtype=None if isinstance(value, float) else object)
    return data


def amplitudes_of(data: deepuwb.DeepUwb) -> np.ndarray:
    return data.samples * data.scale[:, None].astype(np.float64)


WRITINGS: dict[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "arrays": lambda data: data,
    "arrays of float32": lambda data: data.assign(CIR=[row.astype(np.float32) for row in data["CIR"]]),
    "rows of one matrix": lambda data: data.assign(CIR=list(np.stack(list(data["CIR"])))),
    "every other element": lambda data: data.assign(CIR=[np.repeat(row, 2)[::2] for row in data["CIR"]]),
    "arrays of big-endian numbers": lambda data: data.assign(CIR=[row.astype(">f8") for row in data["CIR"]]),
    "lists": lambda data: data.assign(CIR=[row.tolist() for row in data["CIR"]]),
    "lists of numpy scalars": lambda data: data.assign(CIR=[list(row) for row in data["CIR"]]),
    "tuples": lambda data: data.assign(CIR=[tuple(row.tolist()) for row in data["CIR"]]),
    "arrays of objects": lambda data: data.assign(CIR=[row.astype(object) for row in data["CIR"]]),
    "every column of objects": lambda data: data.astype(object),
    "categories": lambda data: data.astype({"Room": "category", "Obstacles": "category"}),
    "text as objects": lambda data: data.astype({"Obstacles": object}),
    "text as strings": lambda data: data.astype({"Obstacles": pd.StringDtype("python")}),
    "rooms as int8": lambda data: data.astype({"Room": np.int8}),
    "rooms as float": lambda data: data.astype({"Room": float}),
    "errors as float32": lambda data: data.astype({"Error": np.float32}),
    "columns in another order": lambda data: data[["Obstacles", "Room", "Error", "CIR"]],
    "a further column": lambda data: data.assign(Note="x", When=3.5),
    "an index of text": lambda data: data.set_index(pd.Index([f"r{i}" for i in range(len(data))])),
    "a block in Fortran order": lambda data: pd.DataFrame(
        np.column_stack([data["Error"], data["Room"]]), columns=["Error", "Room"], copy=False
    ).assign(CIR=data["CIR"], Obstacles=data["Obstacles"]),
}


@pytest.mark.parametrize("writing", WRITINGS)
def test_a_frame_is_read_however_its_cells_are_kept(tmp_path: Path, writing: str) -> None:
    data = frame()
    read = read_deepuwb(written(tmp_path, WRITINGS[writing](data)))
    assert np.allclose(amplitudes_of(read), np.stack(list(data["CIR"])), atol=2e-5)
    assert np.allclose(read.error_m, data["Error"], rtol=1e-6)
    assert list(read.room) == list(data["Room"])
    assert list(read.obstacles) == list(data["Obstacles"])


@pytest.mark.parametrize("version", ["0.25.3", "1.1.5", "1.5.3", "2.2.3"])
def test_frames_of_older_pandas_are_read(version: str) -> None:
    read = read_deepuwb(Path(__file__).parent / "data" / f"deepuwb_pandas_{version}.pkl")
    expected = [np.arange(157) * (row + 1) % 157 / 156 for row in range(4)]
    assert np.allclose(amplitudes_of(read), expected, atol=2e-5)
    assert list(read.error_m) == [0.25, -0.125, 1.5, 0.0]
    assert list(read.room) == [0, 2, 4, 2]
    assert read.obstacles == ("1000000000", "0000001001", "0000000000", "0000000001")


# What a row becomes.


def test_a_record_carries_the_error_over_a_nominal_distance(tmp_path: Path) -> None:
    data = frame()
    for record, error in zip(recording_of(written(tmp_path, data)), data["Error"], strict=True):
        assert record.truth is not None
        assert record.truth.range_m == NOMINAL_RANGE_M
        assert record.measurement.range_m - record.truth.range_m == pytest.approx(error, abs=1e-12)


@pytest.mark.parametrize("error", [-9.9, -1.234567, 1e-4, 0.1, 5.999999, 21.9])
def test_an_error_survives_the_float32_of_a_bag_to_a_micrometre(tmp_path: Path, error: float) -> None:
    recording = recording_of(written(tmp_path, frame(1).assign(Error=[error])))
    with BagWriter(tmp_path / "bag.mcap", {"source": "a test", "simulated": "false"}) as bag:
        for record in recording:
            bag.write(record)
    (record,) = open_recording(tmp_path / "bag.mcap")
    assert record.truth is not None
    assert abs(record.measurement.range_m - record.truth.range_m - error) < 1e-6


def test_the_window_of_the_preprocessing_is_the_whole_cir(tmp_path: Path) -> None:
    data = frame()
    dataset = build_dataset(recording_of(written(tmp_path, data)), Preprocessing(157, Scaling.MAX))
    assert not dataset.refused
    assert np.allclose(dataset.inputs, np.stack(list(data["CIR"])), atol=2e-5)
    # From the largest of a row, each amplitude is within half a count.
    assert np.abs(dataset.inputs - np.stack(list(data["CIR"]))).max() < 0.51 / 32766


def test_what_the_data_lacks_is_unknown_or_made_up_as_documented(tmp_path: Path) -> None:
    records = list(recording_of(written(tmp_path, frame())))
    first, third = records[0].measurement, records[2].measurement
    assert first.cir.encoding is Encoding.MAGNITUDE
    assert first.cir.preamble_count == 0
    assert np.isnan([first.cir.rx_power_dbm, first.cir.first_path_power_dbm]).all()
    assert [record.measurement.sequence for record in records] == list(range(12))
    assert third.stamp_ns - first.stamp_ns == 2 * deepuwb.STAMP_STEP_NS
    assert {r.measurement.anchor_id for r in records} == {1000, 1001, 1002, 1003, 1004}


def test_rooms_and_materials_can_be_read_back(tmp_path: Path) -> None:
    truths = [record.truth for record in recording_of(written(tmp_path, frame()))]
    assert [truth.label for truth in truths if truth][:3] == ["LOS", "NLOS", "NLOS"]
    names = [truth.configuration for truth in truths if truth]
    assert names[:3] == [
        "deepuwb/room0/clear",
        "deepuwb/room1/wall",
        "deepuwb/room2/metal plate+metal window",
    ]
    assert [room_of(name) for name in names[:3]] == [0, 1, 2]
    assert [materials_of(name) for name in names[:3]] == [(), ("wall",), ("metal plate", "metal window")]


@pytest.mark.parametrize(
    ("obstacles", "material"),
    [
        ("1000000000", "wall"),
        ("0100000000", "polystyrene plate"),
        ("0010000000", "plastic"),
        ("0001000000", "plywood plate"),
        ("0000100000", "cardboard box"),
        ("0000010000", "LCD TV"),
        ("0000001000", "metal plate"),
        ("0000000100", "wood door"),
        ("0000000010", "glass plate"),
        ("0000000001", "metal window"),
    ],
)
def test_each_character_stands_for_its_material(obstacles: str, material: str) -> None:
    assert materials_of(deepuwb.configuration_of(3, obstacles)) == (material,)


@pytest.mark.parametrize("name", ["", "deepuwb", "deepuwb/room5/wall", "deepuwb/room1/gold", "by the door"])
def test_a_configuration_of_other_data_is_refused(name: str) -> None:
    with pytest.raises(DatasetError, match="not of DeepUWB"):
        room_of(name)


def test_the_splits_have_the_sizes_of_the_paper() -> None:
    sizes = (954, 18_422, 13_210, 17_601, 4_971)
    names = np.repeat([deepuwb.configuration_of(room, OBSTACLES[0]) for room in range(5)], sizes)
    train, test = split_rows(names, RoomSplit.PAPER)
    assert (train.sum(), test.sum()) == (36_023, 13_210)
    train, test = split_rows(names, RoomSplit.ALL_BUT_ROOM_2)
    assert (train.sum(), test.sum()) == (41_948, 13_210)
    assert not (train & test).any()


def test_a_split_without_test_rows_is_refused() -> None:
    with pytest.raises(DatasetError, match="0 to test on"):
        split_rows(["deepuwb/room1/clear"] * 3, RoomSplit.PAPER)


def test_a_recording_can_be_iterated_again_until_it_is_closed(tmp_path: Path) -> None:
    with open_recording(written(tmp_path, frame()), trust_pickle=True) as recording:
        assert len(list(recording)) == len(list(recording)) == 12
    with pytest.raises(RecordingError, match="closed"):
        next(iter(recording))


def test_a_pickle_is_known_by_its_content(tmp_path: Path) -> None:
    path = written(tmp_path, frame()).rename(tmp_path / "dataset.bin")
    assert isinstance(open_recording(path), DeepUwbRecording)


def test_the_command_line_imports_it_into_a_bag(tmp_path: Path) -> None:
    written(tmp_path, frame())
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "uwb_mitigation.cli",
            "data",
            "import",
            "dataset.pkl",
            "--trust",
            "-o",
            "deepuwb.mcap",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert BagReader(tmp_path / "deepuwb.mcap").message_count == 24


def test_odd_cirs_are_kept_and_counted(tmp_path: Path) -> None:
    data = with_cell("CIR", 1, np.zeros(157))
    data.at[4, "CIR"] = -data.at[4, "CIR"]
    recording = recording_of(written(tmp_path, data))
    assert len(list(recording)) == 12
    assert recording.skipped == {deepuwb.ALL_ZERO: 1, deepuwb.NEGATIVE: 1}


# What is refused.


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        ("CIR", np.zeros(156), "156 samples"),
        ("CIR", [0.5] * 1016, "1016 samples"),
        ("CIR", np.zeros((157, 1)), "no array of numbers"),
        ("CIR", ["0.5"] * 157, "no array of numbers"),
        ("CIR", [[0.5]] * 157, "no array of numbers"),
        ("CIR", None, "missing"),
        ("CIR", "0" * 157, "text"),
        ("CIR", np.array([0.5] * 100 + [np.nan] * 57), "sample 100 is not finite"),
        ("CIR", np.full(157, 1e300), "a peak of 1e"),
        ("Error", float("nan"), "nan"),
        ("Error", float("inf"), "inf"),
        ("Error", 1e6, "1e+06"),
        ("Error", "0.3", "text"),
        ("Room", 5, "5"),
        ("Room", -1, "-1"),
        ("Room", 1.5, "1.5"),
        ("Room", "big", "text"),
        ("Obstacles", "000000000", "'000000000'"),
        ("Obstacles", "00000000000", "'00000000000'"),
        ("Obstacles", "0000000002", "'0000000002'"),
        ("Obstacles", "000000000\n", "'000000000\\n'"),
        ("Obstacles", "٠٠٠٠٠٠٠٠٠٠", "10 characters of 0 or 1"),
        ("Obstacles", 1000000000, "a number"),
    ],
)
def test_a_wrong_cell_is_refused_with_its_row_and_column(
    tmp_path: Path, column: str, value: object, told: str
) -> None:
    path = written(tmp_path, with_cell(column, 7, value))
    with pytest.raises(RecordingError) as caught:
        read_deepuwb(path)
    assert caught.value.where == f"{path}, row 7"
    assert column in caught.value.what
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (frame().drop(columns="Room"), "no column 'Room' (the frame holds: CIR, Error, Obstacles)"),
        (frame().rename(columns={"CIR": "cir"}), "no column 'CIR' (the frame holds: cir"),
        (frame().iloc[:0], "0 rows"),
        (pd.DataFrame(np.zeros((3, 4))), "no column 'CIR' (the frame holds: 0, 1"),
        (frame()["CIR"], "a pickled Series"),
        ({"CIR": [1]}, "a pickled"),
        (np.zeros(3), "a pickled"),
        (None, "a pickled"),
    ],
)
def test_what_is_not_the_data_is_refused_by_what_it_lacks(tmp_path: Path, data: Any, told: str) -> None:
    path = tmp_path / "dataset.pkl"
    path.write_bytes(pickle.dumps(data, protocol=4))
    with pytest.raises(RecordingError) as caught:
        read_deepuwb(path)
    assert str(path) in str(caught.value)
    assert told in str(caught.value)


class Runs:
    """What a hostile pickle wants called."""

    def __init__(self, function: Callable[..., object], *args: object) -> None:
        self.call = (function, args)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return self.call


@pytest.fixture
def stated(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Has the publisher state a checksum."""

    def state(checksum: str) -> None:
        monkeypatch.setattr(deepuwb, "stated_checksum", lambda remote: checksum)

    return state


def test_a_pickle_with_the_published_checksum_is_read(tmp_path: Path, stated: Callable[[str], None]) -> None:
    path = written(tmp_path, frame())
    stated("md5:" + hashlib.md5(path.read_bytes()).hexdigest())
    assert len(deepuwb.read_deepuwb(path)) == 12


def test_another_pickle_is_refused_unread_and_told_how_to_go_on(
    tmp_path: Path, stated: Callable[[str], None]
) -> None:
    mark, path = tmp_path / "ran", tmp_path / "dataset.pkl"
    path.write_bytes(pickle.dumps(with_cell("CIR", 2, Runs(os.system, f"touch '{mark}'"))))
    stated("md5:" + "0" * 32)
    with pytest.raises(
        RecordingError, match=r"not the published dataset.pkl; a pickle is a program.*--trust"
    ):
        deepuwb.read_deepuwb(path)
    assert not mark.exists()


def test_without_the_publisher_a_pickle_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(url: str, **options: Any) -> requests.Response:
        raise requests.ConnectionError("no route to host")

    monkeypatch.setattr(requests, "get", unreachable)
    with pytest.raises(RecordingError, match=r"cannot be told.*no route to host.*--trust"):
        deepuwb.read_deepuwb(written(tmp_path, frame()))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (pickle.dumps(frame())[:500], "not a pickle that pandas"),
        (b"\x80\x04nonsense", "not a pickle that pandas"),
        (pickle.dumps(Runs(float, "x")), "ValueError"),
    ],
)
def test_a_trusted_file_that_is_no_pickle_is_refused(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "dataset.pkl"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=told) as caught:
        read_deepuwb(path)
    assert caught.value.where == str(path)


def test_a_missing_category_is_refused_as_missing(tmp_path: Path) -> None:
    data = frame().astype({"Obstacles": "category"})
    data.loc[3, "Obstacles"] = None
    with pytest.raises(RecordingError, match="row 3: Obstacles: missing"):
        read_deepuwb(written(tmp_path, data))
