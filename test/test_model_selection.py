"""Model selection, and `train`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import run, succeed
from model_material import Recorded, bundle, dataset, measurement, windows

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.recordings import formats
from uwb_mitigation.recordings.csv_tables import load_truth, with_truth
from uwb_mitigation.training.fit import linear_fit
from uwb_mitigation.types.measurement import Record, Truth

pytest.importorskip("torch", reason="run `make setup-training`")
from uwb_mitigation.mitigation.model.floating import float_network
from uwb_mitigation.training.data import recordings
from uwb_mitigation.training.fit import candidates, selection
from uwb_mitigation.training.fit.candidates import Candidate, FittedModel, Recipe, network_m
from uwb_mitigation.training.fit.options import FitOptions
from uwb_mitigation.training.fit.selection import NESTED

SHAPE = Remnet(samples=8)
RECIPE = Recipe(SHAPE, FitOptions(epochs=1))


def fixed_offset(name: str, offset_m: float, trains: bool = False) -> Candidate:
    return Candidate(name, lambda data, seed: FittedModel(LinearBiasModel(offset_m)), trains)


CONSTANTS = [fixed_offset("none", 0.0), fixed_offset("half", 0.5), fixed_offset("quarter", 0.25)]


def numbered(error_of):
    """Return a dataset of 12 configurations with the errors `error_of`(configuration number)."""
    data = dataset(12, 5, samples=8)
    error = np.array([error_of(int(name[1:])) for name in data.configurations], float)
    return replace(data, error_m=error, range_m=3.0 + error)


def test_simplest_candidate_is_preferred_unless_a_richer_one_gains():
    errors = {"a": np.array([1.0]), "b": np.array([0.99]), "c": np.array([0.9])}
    assert selection.select_simplest(errors, 0.02) == "c"
    assert selection.select_simplest(errors, 0.2) == "a"


def test_line_is_selected_only_for_errors_that_depend_on_power():
    constant = selection.select_nested(numbered(lambda number: 0.3), candidates.new_models(RECIPE), 2, 0)
    assert constant.chosen == candidates.CONSTANT
    assert constant.mae()[NESTED] < 1e-6
    data = dataset(14, 5, samples=8)
    data = replace(data, error_m=-5.1 - 0.069 * data.rx_power_dbm.astype(float))
    line = selection.select_nested(data, candidates.new_models(RECIPE), 2, 0)
    assert line.chosen == candidates.LINE
    assert line.model.linear_bias.per_rx_power == pytest.approx(-0.069, abs=1e-3)


def test_trained_network_must_show_its_gain_in_the_nested_error(monkeypatch):
    data = numbered(lambda number: 0.3)
    offered = [*CONSTANTS[:2], fixed_offset("quarter", 0.25, trains=True)]
    assert selection.select_nested(data, offered, 3, 0).chosen == "quarter"
    prefer = selection.select_simplest

    def select_simplest(errors, min_gain=0.02):
        """The inner folds prefer another candidate, so that the selection has a larger error."""
        return "half" if len(next(iter(errors.values()))) < len(data) else prefer(errors, min_gain)

    monkeypatch.setattr(selection, "select_simplest", select_simplest)
    assert selection.select_nested(data, offered, 3, 0).chosen == "half"


def test_cold_start_fits_an_offset(tmp_path):
    data, source = dataset(20, 3, samples=32), bundle(tmp_path)
    _, start, *_ = candidates.with_cold_start(candidates.new_models(RECIPE), data, source)
    network = network_m(float_network(source), data.inputs)
    shift = linear_fit.fit_constant(data.configurations, data.error_m - network).offset_m
    assert np.std(network) > 0.01
    assert start.fit(data, 0).correction_m(data) == pytest.approx(network + shift, abs=1e-5)


def test_cold_start_is_preferred_with_few_configurations_only(tmp_path):
    source, own = bundle(tmp_path), candidates.new_models(RECIPE)

    def names(data) -> list[str]:
        return [item.name for item in candidates.with_cold_start(own, data, source)]

    assert names(dataset(19, 2)) == [candidates.COLD_START, *candidates.NEW_MODELS]
    assert names(dataset(20, 2)) == ["constant", candidates.COLD_START, "line", "line+network", "network"]
    assert names(dataset(20, 2, samples=8)) == list(candidates.NEW_MODELS)


def write(folder, *rows: str, header: str = "tag_id,anchor_id,range_m,start_s,stop_s,configuration"):
    path = folder / "truth.csv"
    path.write_text("\n".join((header, *rows)) + "\n")
    return path


def at(seconds: float) -> Record:
    return Record(replace(measurement(3.0), stamp_ns=10**18 + round(seconds * 1e9)))


def test_truth_table_assigns_ranges_by_pair_and_time(tmp_path):
    table = load_truth(write(tmp_path, "1,2,2.5,0,10,door", "1,2,3.5,10,,"))
    truths = [item.truth for item in with_truth([at(0), at(9.9), at(10), at(500)], table)]
    assert [truth.range_m for truth in truths] == [2.5, 2.5, 3.5, 3.5]
    assert [truth.configuration for truth in truths[::2]] == ["door", "truth.csv row 2"]
    assert next(with_truth([at(0)], load_truth(write(tmp_path, "1,3,2.5,,,")))).truth is None


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("1,2,nan,,,", "range_m"),
        ("1,2,-1,,,", "range_m"),
        ("one,2,3,,,", "tag_id"),
        ("1,99999999999999999999,3,,,", "anchor_id"),
        ("1,2,3,5,5,", "start_s"),
        ("1,2", "range_m"),
    ],
)
def test_invalid_row_is_named(tmp_path, row, named):
    with pytest.raises(RecordingError, match=named) as caught:
        load_truth(write(tmp_path, row))
    assert "row 1" in str(caught.value)


def test_file_that_is_not_a_truth_table_is_refused(tmp_path):
    (tmp_path / "binary.csv").write_bytes(b"\xff\x00\xfe")
    without_anchor = write(tmp_path, "1,2,3", header="tag_id,anchor,range_m").rename(tmp_path / "columns.csv")
    for path in (tmp_path / "absent.csv", tmp_path / "binary.csv", write(tmp_path), without_anchor):
        with pytest.raises(RecordingError) as caught:
            load_truth(path)
    assert caught.value.suggestion == "did you mean 'anchor'?"


EIGHT_PLACES = [f"{place},2,3.0,,,place {place}" for place in range(8)]


@pytest.fixture
def eight_places(monkeypatch) -> Recorded:
    """Return a recording of ranges with an error of 0.25 m."""
    ranges = [
        Record(replace(measurement(3.25, 10 * place + number), tag_id=place))
        for place in range(8)
        for number in range(4)
    ]
    monkeypatch.setattr(formats, "open_recording", lambda path: Recorded(ranges))
    return Recorded(ranges)


def loads(monkeypatch, data) -> None:
    monkeypatch.setattr(recordings, "load_dataset", lambda *_: ("made up", data))


def test_true_ranges_of_a_table_are_used(tmp_path, eight_places):
    write(tmp_path, *EIGHT_PLACES)
    words = "--truth truth.csv --recipe constant --folds 2 -o own.onnx --json own.json"
    succeed(f"train --from-bag bag {words}", folder=tmp_path)
    assert json.loads((tmp_path / "own.json").read_text())["improved"]
    assert load_bundle(tmp_path / "own.onnx").card.linear_bias.offset_m == pytest.approx(0.25)


def test_few_configurations_start_from_the_universal_network(tmp_path, monkeypatch):
    loads(monkeypatch, dataset(6, 3, samples=157))
    far_off = fixed_offset(candidates.CONSTANT, 9.0)
    monkeypatch.setattr(candidates, "new_models", lambda recipe: [far_off])
    words = "train --data . -o cold.onnx"
    done = succeed(f"{words} --folds 2 --json cold.json", folder=tmp_path, columns=80)
    found, made = json.loads((tmp_path / "cold.json").read_text()), load_bundle(tmp_path / "cold.onnx")
    start = load_bundle(default_model_path())
    assert found["choice"]["chosen"] == made.card.training["chosen"] == candidates.COLD_START
    # The mark is in the line of the chosen candidate, also with 80 columns.
    assert [line for line in done.stdout.splitlines() if "<-" in line and candidates.COLD_START in line]
    mae = {row["name"]: row["mae"] for row in found["choice"]["rows"]}
    assert found["improved"] == (mae[NESTED] < mae["raw"])
    assert "exists" in run(words, folder=tmp_path).stderr
    assert set(found) == {"model_id", "n", "skipped", "rows", "improved", "by_configuration", "choice"}
    inputs = windows(5, 157)
    expected = network_m(float_network(start), inputs)
    assert network_m(float_network(made), inputs) == pytest.approx(expected, abs=1e-6)


def test_harmful_model_is_reported(tmp_path, monkeypatch):
    # Without one of the two configurations with an error of 1 m, the constant is that of the two with -1 m.
    data = dataset(4, 3, samples=8)
    loads(monkeypatch, replace(data, error_m=np.where(np.isin(data.configurations, ("c0", "c1")), 1.0, -1.0)))
    words = "--recipe constant --samples 8 -o x.onnx --json x.json"
    assert "not better than measured ranges" in succeed(f"train --data . {words}", folder=tmp_path).stdout
    assert json.loads((tmp_path / "x.json").read_text())["improved"] is False
    assert load_bundle(tmp_path / "x.onnx").card.training["recipe"] == {"line": False, "network": False}


def test_network_is_compared_with_the_best_baseline(tmp_path, monkeypatch):
    # All ranges have the same error: nothing is better than a constant.
    data = numbered(lambda number: 0.3)
    loads(monkeypatch, data)
    words = "--recipe network --samples 8 --epochs 1 -o x.onnx"
    done = succeed(f"train --data . {words}", folder=tmp_path)
    assert "best baseline, one constant offset: 0.000 m" in done.stdout
    assert "Warning: the model is not better than one constant offset" in done.stdout


@pytest.mark.parametrize(
    ("configurations", "options", "needed"),
    [(2, "", "3 or more"), (3, "--folds 2", "4 or more"), (1, "--recipe line", "2 or more")],
)
def test_too_few_configurations_are_refused(tmp_path, monkeypatch, configurations, options, needed):
    loads(monkeypatch, dataset(configurations, 3))
    assert needed in run(f"train --data . -o x.onnx {options}", folder=tmp_path).stderr


def test_data_without_preamble_counts_needs_the_other_scaling(tmp_path, eight_places):
    for item in eight_places:
        object.__setattr__(item.measurement.cir, "preamble_count", 0)
        object.__setattr__(item, "truth", Truth(3.0, configuration=f"{item.measurement.tag_id}"))
    for command in ("train -o x.onnx", "evaluate --cross-validate configuration"):
        assert "--scaling max" in run(f"{command} --data bag", folder=tmp_path).stderr
