"""The public API: the names of `uwb_mitigation`, and the examples of its page."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records
from conftest import REPOSITORY
from model_material import changed

import uwb_mitigation
from uwb_mitigation import (
    AnchorMap,
    Mitigation,
    RangeMeasurement,
    Record,
    SiteCalibration,
    UwbMitigationError,
    load_anchors,
    load_model,
    open_recording,
    to_dataframe,
    track,
)
from uwb_mitigation.errors import DamagedRecordingError, ModelError, ParameterError
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.anchors import save_anchors
from uwb_mitigation.types.measurement import is_logarithmic

os.environ["MPLBACKEND"] = "agg"
PAGE = REPOSITORY / "docs" / "guides" / "python.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `drive.mcap`, `site.mcap` and `anchors.yaml`."""
    path = tmp_path_factory.mktemp("drive")
    for name, count in (("drive", 400), ("site", 2000)):
        write_records(path / f"{name}.mcap", SimulatedSource(seed=1, count=count))
    save_anchors(path / "anchors.yaml", SimulatedSource().anchors)
    return path


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return list(SimulatedSource(seed=2, count=300))


@pytest.fixture(scope="module")
def mitigation() -> Mitigation:
    return Mitigation(load_model("universal"), offsets=0.22)


def test_import_loads_no_other_package_and_all_names_exist():
    code = (
        "import sys\nbefore = set(sys.modules)\nimport uwb_mitigation\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - sys.stdlib_module_names\n"
        "assert new == {'uwb_mitigation'}, new\n"
        "from uwb_mitigation import *\n"
        "assert not {'rclpy', 'torch', 'pandas', 'onnxruntime'} & set(sys.modules)\n"
        "assert set(uwb_mitigation.__all__) <= set(dir(uwb_mitigation)) & set(globals())\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)
    source = Path(uwb_mitigation.__file__).read_text(encoding="utf-8")
    assert {*uwb_mitigation.__all__} == {*re.findall(r"import (\w+) as \1\n", source)}
    assert {*dir(uwb_mitigation)} == {*uwb_mitigation.__all__, "__version__"}
    with pytest.raises(AttributeError, match="no attribute 'Mitigator'"):
        uwb_mitigation.Mitigator  # noqa: B018


def test_loading_a_model_writes_no_file_to_the_home_folder(tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    code = "import uwb_mitigation; uwb_mitigation.load_model()"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, env=environment)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_of_the_page_run(number: int, folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    exec(compile(EXAMPLES[number], f"{PAGE.name}, example {number + 1}", "exec"), names)
    if "calibrate" in names:
        site = names["site"]
        assert isinstance(site, SiteCalibration)
        calibrated = Mitigation(load_model(folder / "site.onnx"), str(folder / "site.offsets.yaml"))
        others = list(SimulatedSource(seed=2, count=500))
        measured = [record.measurement for record in others]
        true_m = np.array([record.truth.range_m for record in others])
        raw_mae_m, calibrated_mae_m = (
            np.abs([each.range_m for each in ranges] - true_m).mean()
            for ranges in (measured, calibrated.correct(measured))
        )
        assert calibrated_mae_m < 0.5 * raw_mae_m
        assert site.offsets.lookup(np.array([101]), np.array([1])) == pytest.approx(0.22, abs=0.15)
        assert load_model(folder / "site.onnx").model_id


def samples(measurement: RangeMeasurement) -> np.ndarray:
    pairs = measurement.cir.samples.reshape(-1, 2)
    return pairs[:, 0] + 1j * pairs[:, 1]


@pytest.mark.parametrize("gain", [1.0, 0.37])
def test_arrays_are_corrected_like_measurements(mitigation: Mitigation, records: list[Record], gain: float):
    measurements = [record.measurement for record in records]
    cirs = [measurement.cir for measurement in measurements]
    model = mitigation if gain == 1.0 else Mitigation(load_model("universal_amplitude"), 0.22)
    expected = model.correct(measurements)
    names = ("preamble_count", "rx_power_dbm", "first_path_power_dbm")
    result = model.correct_arrays(
        [measurement.range_m for measurement in measurements],
        gain * np.stack([samples(measurement) for measurement in measurements]),
        [cir.first_path_index - cir.start_index for cir in cirs],
        **{name: [getattr(cir, name) for cir in cirs] for name in names},
    )
    limit = 0.0 if gain == 1.0 else 0.03
    assert np.abs(result.range_m - [corrected.range_m for corrected in expected]).max() <= limit
    assert model.correct(measurements[0]) == expected[0]


def test_complex_samples_and_pickled_copies_give_the_same_correction(
    mitigation: Mitigation, records: list[Record]
):
    record = records[0]
    expected = mitigation.correct(record.measurement)
    converted = changed(record, {"samples": samples(record.measurement)}).measurement
    assert mitigation.correct(converted) == expected
    assert pickle.loads(pickle.dumps(mitigation)).correct(record.measurement) == expected


def test_cir_that_is_not_finite_is_not_used(mitigation: Mitigation, records: list[Record]):
    measurement = records[0].measurement
    cir = np.stack([samples(measurement)] * 2)
    cir[0, 900] = np.nan
    index = measurement.cir.first_path_index - measurement.cir.start_index
    result = mitigation.correct_arrays(measurement.range_m, cir, index, preamble_count=100)
    assert result.status.tolist()[0] == uwb_mitigation.Status.BAD_CIR
    assert "NaN" in result.reason[0]


@pytest.mark.parametrize(
    ("changes", "excerpt"),
    [
        ({"cir": [1.0, 2.0]}, "cir[None]"),
        ({"cir": [[1.0], [1.0, 2.0]]}, "different lengths"),
        ({"cir": [["a"]]}, "real or complex numbers"),
        ({"cir": np.resize([500, -3], (2, 400))}, "1j * q"),
        ({"cir": np.linspace(40.0, 80.0, 400)[None]}, "10 ** (level / 20)"),
        ({"range_m": [1.0, 2.0, 3.0]}, "range_m"),
        ({"first_path_index": "x"}, "first_path_index"),
        ({"first_path_index": 205.0}, "205 to 205 is outside of every row"),
        ({"start_index": 100}, "-80 to -80 is outside of every row"),
        ({"range_m": [5299.78, 870.0]}, "divide millimetres by 1000"),
        ({"cir": 20 * np.log10(np.random.default_rng(1).rayleigh(9.0, (3, 200)) + 1)}, "10 ** (level / 20)"),
        ({"tag_id": -1}, "tag_id"),
        ({"preamble": 3}, "preamble_count"),
    ],
)
def test_wrong_arrays_are_refused_with_a_remedy(mitigation: Mitigation, changes: dict, excerpt: str):
    arguments = {"range_m": 1.0, "cir": np.ones((2, 200)), "first_path_index": 20.0} | changes
    with pytest.raises(ParameterError, match=re.escape(excerpt)):
        mitigation.correct_arrays(**arguments)


@pytest.mark.parametrize(
    ("code", "kind", "excerpt"),
    [
        ("load_model(3)", ModelError, "universal"),
        ("Mitigation('universal')", ModelError, "load_model()"),
        ("Mitigation(load_model(), offsets={1: 0.1})", ParameterError, "anchors: {id: m}"),
        ("Mitigation(load_model()).correct([5.0])", ParameterError, "record.measurement"),
        *((f"Cir({values})", ParameterError, "1j") for values in ("[1.0] * 9", "[[1j] * 9] * 2", "['a']")),
        ("AnchorMap({1: (0, 0)})", ParameterError, "(x, y, z)"),
        ("AnchorMap([(0, 0, 0)])", ParameterError, "(x, y, z)"),
        ("TagLocator(3)", ParameterError, "(x, y, z)"),
        ("TagLocator({1: (0, 0, 0)}).add(measurement, 5.0)", ParameterError, "Mitigation.correct"),
        ("TagLocator({1: (0, 0, 0)}).add(5.0)", ParameterError, "record.measurement"),
    ],
)
def test_other_types_are_refused_with_the_valid_ones(
    records: list[Record], code: str, kind: type[UwbMitigationError], excerpt: str
):
    names = {name: getattr(uwb_mitigation, name) for name in uwb_mitigation.__all__}
    with pytest.raises(kind, match=re.escape(excerpt)):
        eval(code, names | {"measurement": records[0].measurement})


def test_dictionaries_are_anchors_and_offsets(mitigation: Mitigation):
    assert AnchorMap({1: (0, 0, 2), 0x1F: np.ones(3)}).position.tolist() == [[0, 0, 2], [1, 1, 1]]
    assert Mitigation(mitigation.bundle, {"anchors": {1: 0.5}}).offsets.lookup([7], [1]) == [0.5]


def test_track_of_a_recording_has_errors_data_frame_file_and_plot(tmp_path: Path, folder: Path):
    tracks = track(folder / "drive.mcap", folder / "anchors.yaml", offsets=0.22, height_m=0.4)
    assert (len(tracks), tracks.warnings) == (1, [])
    (tag,) = tracks
    assert tag.errors["smoothed"].rmse < tag.errors["snapshot"].rmse
    frame = tracks.to_dataframe()
    assert np.array_equal(frame[["x", "y", "z"]], tag.smoothed.positions_xyz)
    assert np.sqrt((frame["error_m"] ** 2).mean()) == pytest.approx(tag.errors["smoothed"].rmse)
    (file,) = tracks.write_tum(tmp_path / "track.tum")
    evo = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file(file)
    for name in ("timestamps", "positions_xyz", "orientations_quat_wxyz"):
        assert getattr(evo, name) == pytest.approx(getattr(tag.smoothed, name), abs=1e-6)
    labels = [text.get_text() for text in tracks.plot().get_legend().get_texts()]
    assert f"smoothed (RMSE {tag.errors['smoothed'].rmse:.2f} m)" in labels


def test_track_of_records_equals_that_of_their_bag(folder: Path):
    records = list(open_recording(folder / "drive.mcap"))
    anchors = {anchor.id: anchor.position for anchor in load_anchors(folder / "anchors.yaml").anchors}
    (of_records,), (of_bag,) = (
        track(recording, anchors, offsets=0.22, height_m=0.4)
        for recording in (records, folder / "drive.mcap")
    )
    assert np.array_equal(of_records.smoothed.position, of_bag.smoothed.position)


def test_magnitudes_in_db_are_detected_and_linear_ones_are_not(records: list[Record]):
    for record in records:
        magnitude = np.abs(samples(record.measurement))
        window = magnitude[int(record.measurement.cir.first_path_index) - 5 :][:157]
        assert not is_logarithmic(magnitude)
        assert is_logarithmic(20.0 * np.log10(np.maximum(magnitude, 1.0)))
        assert is_logarithmic(20.0 * np.log10(window + 1.0))
    generator = np.random.default_rng(1)
    assert not any(is_logarithmic(generator.rayleigh(30.0, 157)) for _ in range(1000))


def test_records_before_the_damage_are_corrected(mitigation: Mitigation, records: list[Record]):
    def damaged():
        yield from records
        raise DamagedRecordingError("truncated")

    pairs = []
    with pytest.raises(DamagedRecordingError):
        pairs.extend(mitigation.correct_records(damaged()))
    assert [record for record, _ in pairs] == records


def test_data_frame_has_raw_and_corrected_ranges(mitigation: Mitigation, records: list[Record]):
    frame = to_dataframe(mitigation.correct_records(records))
    raw, corrected = (
        (frame[name] - frame.true_range_m).abs().mean() for name in ("range_m", "corrected_range_m")
    )
    assert corrected < 0.5 * raw
    assert list(to_dataframe(records)) == list(frame)[:-3]
    assert to_dataframe([]).empty
