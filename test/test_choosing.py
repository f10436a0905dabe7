"""Choosing what a data set can carry, and fitting a model to a site of one's own."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from model_material import bundle, dataset, measurement, windows
from typer.testing import CliRunner

from uwb_mitigation.commands import model_tables
from uwb_mitigation.commands.cli import app
from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError
from uwb_mitigation.evaluation.lad import constant as fit_constant
from uwb_mitigation.measurement import Record, Truth
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.sources import opening
from uwb_mitigation.sources.truth_table import load_truth, with_truth

pytest.importorskip("torch", reason="run `make setup-training`")
from uwb_mitigation.model.float_networks import float_network
from uwb_mitigation.training import adaptation, choosing, cold_start, comparison, parts
from uwb_mitigation.training import recipe as recipes
from uwb_mitigation.training.choosing import Candidate, Choice
from uwb_mitigation.training.fitting import FitOptions
from uwb_mitigation.training.recipe import Recipe, fit_model

SHAPE = Remnet(samples=8)
CONSTANTS = [
    Candidate(name, lambda data, seed, offset=offset: (LinePrior(offset), None))
    for name, offset in (("none", 0.0), ("half", 0.5), ("quarter", 0.25))
]


def numbered(error_of) -> object:
    """A dataset of 12 configurations whose errors are those of `error_of`(configuration number)."""
    data = dataset(12, 5, samples=8)
    error = np.array([error_of(int(name[1:])) for name in data.configurations], float)
    return replace(data, error_m=error, range_m=3.0 + error)


def test_the_simplest_is_kept_unless_a_richer_one_gains():
    errors = {"a": np.array([1.0]), "b": np.array([0.99]), "c": np.array([0.9])}
    assert choosing.preferred(errors, 0.02) == "c"
    assert choosing.preferred(errors, 0.2) == "a"


def test_a_constant_error_needs_no_line():
    recipe = Recipe(SHAPE, FitOptions(epochs=1))
    choice = choosing.choose(numbered(lambda number: 0.3), choosing.standard(recipe), 3, 0)
    assert choice.chosen == choosing.CONSTANT
    assert choice.mae()[choosing.NESTED] < 1e-6


def test_an_error_that_follows_the_power_needs_a_line():
    data = dataset(14, 5, samples=8)
    error = -5.1 - 0.069 * data.rx_power_dbm.astype(float)
    recipe = Recipe(SHAPE, FitOptions(epochs=1))
    choice = choosing.choose(replace(data, error_m=error), choosing.standard(recipe), 3, 0)
    assert choice.chosen == choosing.LINE


def test_what_is_told_of_the_choice_was_not_chosen_on():
    # The candidate that is best in each fold is worst elsewhere: only a nested test can tell.
    data = numbered(lambda number: 0.5 if number < 6 else 0.0)
    choice = choosing.choose(data, CONSTANTS[:2], 2, 0)
    names = data.configurations
    for part in (names == "c0", names == "c11"):
        assert np.isin(np.abs(choice.errors[choosing.NESTED][part]), (0.0, 0.5)).all()
    assert choice.mae()[choosing.NESTED] >= min(choice.mae()[name] for name in ("none", "half"))


def test_the_curve_tells_how_many_configurations_would_do():
    points = tuple((n, 0.1 + 1.0 / n) for n in (5, 10, 20))
    choice = Choice("line", {}, points, 3, 0, 20)
    # 0.95 x 0.15 = 0.1425 = 0.1 + 1 / n
    assert choice.needed() == pytest.approx(24, abs=1)
    # With 40 at hand already: 0.95 x 0.125 = 0.11875
    assert replace(choice, configurations=40).needed() == pytest.approx(54, abs=1)


@pytest.mark.parametrize("points", [((5, 0.2), (10, 0.2), (20, 0.2)), ((5, 0.1), (10, 0.2), (20, 0.3)), ()])
def test_a_curve_that_is_flat_promises_nothing(points):
    assert Choice("line", {}, points, 3, 0, 20).needed() is None


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ((), FitOptions(20, 1e-3, dropout=0.2)),
        # As asked for, though it is the default of a network behind a line.
        (("--epochs", 5, "--learning-rate", 3e-4, "--seed", 1), FitOptions(5, 3e-4, dropout=0.2, seed=1)),
    ],
)
def test_a_network_alone_is_trained_longer_unless_asked_otherwise(tmp_path, monkeypatch, asked, expected):
    monkeypatch.setattr(parts, "load", lambda *_: ("made up", dataset(4, 3, samples=8)))
    monkeypatch.setattr(
        recipes, "cross_validate", lambda data, recipe, *_: pytest.fail(f"{recipe.fit}", pytrace=False)
    )
    with pytest.raises(pytest.fail.Exception) as caught:
        run_or_raise("train", "--data", tmp_path, "--recipe", "network", "-o", tmp_path / "x.onnx", *asked)
    assert str(caught.value) == str(expected)


@pytest.mark.parametrize(
    ("points", "outlook"),
    [
        (((2, 0.2), (3, 0.2)), "Too few configurations to say"),
        (((5, 0.2), (10, 0.2), (20, 0.2)), "are not expected to lower it"),
        (((5, 0.3), (10, 0.2), (20, 0.15)), "configurations lower it by 5%"),
    ],
)
def test_a_curve_that_is_short_is_not_taken_for_a_flat_one(points, outlook, capsys):
    model_tables.show_choice(Choice("line", {"line": np.ones(3)}, points, 3, 0, 20))
    assert outlook in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("after", "verdict"), [(0.4, "20% lower"), (0.6, "20% higher: this did not help")])
def test_a_model_that_harms_is_called_so(after, verdict, capsys):
    model_tables.show_verdict(after, {"raw": 0.5})
    assert verdict in " ".join(capsys.readouterr().out.split())


def test_a_recipe_that_harms_is_told_as_one(tmp_path, monkeypatch):
    # Without one of two places that err by 1 m, the constant is that of the two that err by -1 m, and the reverse.
    data = dataset(4, 3, samples=8)
    data = replace(data, error_m=np.where(np.isin(data.configurations, ("c0", "c1")), 1.0, -1.0))
    monkeypatch.setattr(parts, "load", lambda *_: ("made up", data))
    output, result = tmp_path / "x.onnx", tmp_path / "x.json"
    told = run_or_raise(
        "train", "--data", tmp_path, "--recipe", "constant", "--samples", 8, "-o", output, "--json", result
    )
    assert "2.000 m against 1.000 m raw: 100% higher: this did not help" in " ".join(told.split())
    assert json.loads(result.read_text())["helped"] is False
    # Of a network that was not fitted, the card tells no epochs.
    assert load_bundle(output).card.training["recipe"] == {"line": False, "network": False}


def predicted(fitted, data) -> np.ndarray:
    prior, network = fitted
    of_network = 0 if network is None else floating.predict_m(network, data.inputs)
    return prior.predict_m(data.rx_power_dbm, data.first_path_power_dbm) + of_network


def test_the_cold_start_fits_an_offset_alone_and_the_mean_a_line_too(tmp_path):
    data, source = dataset(20, 3, samples=32), bundle(tmp_path)
    offered = cold_start.offered(choosing.standard(Recipe(SHAPE, FitOptions())), data, source)
    found = {
        item.name: predicted(item.fit(data, 0), data) for item in offered if item.name in cold_start.NAMES
    }
    line = predicted((choosing.line(data), None), data)
    network = floating.predict_m(float_network(source), data.inputs)
    shift = fit_constant(data.configurations, data.error_m - network).offset_m
    assert np.std(network) > 0.01
    assert found[cold_start.NAME] == pytest.approx(network + shift, abs=1e-5)
    assert found[cold_start.MEAN] == pytest.approx((line + network + shift) / 2, abs=1e-5)


def test_the_cold_start_comes_first_where_placements_are_few_and_the_mean_where_they_are_not(tmp_path):
    source, usual = bundle(tmp_path), choosing.standard(Recipe(SHAPE, FitOptions()))
    plain = ["constant", "line", "line+network", "network"]

    def names(data) -> list[str]:
        return [item.name for item in cold_start.offered(usual, data, source)]

    assert names(dataset(19, 2)) == [cold_start.NAME, *plain]
    many = dataset(20, 2)
    assert names(many) == ["constant", cold_start.NAME, "line", cold_start.MEAN, "line+network", "network"]
    assert names(dataset(20, 2, samples=8)) == plain
    many.rx_power_dbm[:2] = np.nan  # One placement of the twenty without power levels.
    assert names(many) == ["constant", cold_start.NAME, "line", "line+network", "network"]


def test_a_trained_network_must_show_its_gain_where_no_choice_has_seen(monkeypatch):
    data = numbered(lambda number: 0.3)
    none, half, quarter = (replace(item, trains=item.name == "quarter") for item in CONSTANTS)
    assert choosing.choose(data, [none, half, quarter], 3, 0).chosen == "quarter"
    # The folds within prefer another, so that choosing leaves more than the candidate would.
    monkeypatch.setattr(choosing, "_held_out", lambda *_: {"none": np.zeros(1), "half": np.ones(1)})
    assert choosing.choose(data, [none, half, quarter], 3, 0).chosen == "half"


@pytest.mark.parametrize("name", [choosing.CONSTANT, choosing.LINE])
def test_a_recipe_without_network_leaves_it_silent(name):
    data = dataset(8, 5, samples=8)
    prior, network = fit_model(data, choosing.recipe_of(name, Recipe(SHAPE, FitOptions(epochs=1))))
    assert not any(values.any() for key, values in network.weight.items() if key == "head")
    assert prior.needs_power == (name == choosing.LINE)


def write(folder, *rows: str, header: str = "tag_id,anchor_id,range_m,start_s,stop_s,configuration"):
    path = folder / "truth.csv"
    path.write_text("\n".join((header, *rows)) + "\n")
    return path


def at(seconds: float) -> Record:
    return Record(replace(measurement(3.0), stamp_ns=10**18 + round(seconds * 1e9)))


def test_a_truth_table_gives_pairs_and_times_their_ranges(tmp_path):
    table = load_truth(write(tmp_path, "1,2,2.5,0,10,door", "1,2,3.5,10,,"))
    truths = [item.truth for item in with_truth([at(0), at(9.9), at(10), at(500)], table)]
    assert [truth.range_m for truth in truths] == [2.5, 2.5, 3.5, 3.5]
    assert truths[0].configuration == "door"
    assert truths[2].configuration == "truth.csv line 3"


def test_a_pair_that_is_not_in_the_table_has_no_truth(tmp_path):
    table = load_truth(write(tmp_path, "1,3,2.5,,,"))
    assert next(with_truth([at(0)], table)).truth is None


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
def test_a_row_that_is_wrong_is_named(tmp_path, row, named):
    with pytest.raises(RecordingError, match=named) as caught:
        load_truth(write(tmp_path, row))
    assert "line 2" in str(caught.value)


def test_a_table_that_is_none_is_refused(tmp_path):
    (tmp_path / "binary.csv").write_bytes(b"\xff\x00\xfe")
    for path in (tmp_path / "absent.csv", tmp_path / "binary.csv", write(tmp_path)):
        with pytest.raises(RecordingError):
            load_truth(path)
    with pytest.raises(RecordingError, match="anchor_id"):
        load_truth(write(tmp_path, "1,2", header="tag_id,range_m"))


class Recorded(list):
    simulated = False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def run(*arguments: object):
    return CliRunner().invoke(app, [str(value) for value in arguments], catch_exceptions=True)


def run_or_raise(*arguments: object) -> str:
    result = run(*arguments)
    if result.exception is not None:
        raise result.exception
    return result.output


EIGHT_PLACES = [f"{place},2,3.0,,,place {place}" for place in range(8)]


def ranges_of_eight_places() -> list[Record]:
    """Ranges that err by 0.25 m."""
    return [
        Record(replace(measurement(3.25, 10 * place + number), tag_id=place))
        for place in range(8)
        for number in range(4)
    ]


def test_a_bag_of_few_places_starts_from_the_simulator_too(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "open_recording", lambda path: Recorded(ranges_of_eight_places()))
    as_it_is = Candidate(adaptation.AS_SHIPPED, lambda data, seed: (LinePrior(0.0), None))
    monkeypatch.setattr(adaptation, "candidates", lambda source, options: [as_it_is])
    output = tmp_path / "own.onnx"
    done = run(
        "train", "--from-bag", "bag", "--truth", write(tmp_path, *EIGHT_PLACES), "-o", output, "--folds", 2
    )
    assert done.exit_code == 0, done.output
    start = load_bundle(default_model_path())
    assert load_bundle(output).card.training["chosen"] == cold_start.NAME
    assert load_bundle(output).card.training["started_from"] == f"{start.model_id:08x}"
    # No network was fitted, so that the card tells of no epochs.
    assert load_bundle(output).card.training["recipe"] == {"line": False, "network": True}


def test_the_card_tells_how_a_network_was_fitted_that_was(tmp_path):
    data, source = dataset(8, 3), bundle(tmp_path)
    choice = Choice(
        adaptation.TRAINED_FURTHER, {"raw": data.error_m, "trained further": data.error_m}, (), 2, 0, 8
    )
    options = FitOptions(epochs=1)
    graded, _ = adaptation.fit_chosen(
        data, choice, adaptation.candidates(source, options), source, options, "own", "bag"
    )
    assert graded.card.training["recipe"]["epochs"] == 1
    assert graded.card.training["recipe"]["network"]


def test_a_bag_of_ones_own_refits_the_offset_and_says_what_it_helped(tmp_path, monkeypatch):
    # Shaped as the simulator's network, which a model that is named is not exchanged for.
    started = bundle(tmp_path, Remnet(), prior=LinePrior(5.0))
    monkeypatch.setattr(opening, "open_recording", lambda path: Recorded(ranges_of_eight_places()))
    table = write(tmp_path, *EIGHT_PLACES)
    output, result = tmp_path / "own.onnx", tmp_path / "own.json"
    done = run(
        "train", "--from-bag", "bag", "--truth", table, "--model", started.path, "-o", output,
        "--epochs", 1, "--folds", 2, "--json", result,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    found = json.loads(result.read_text())
    assert found["helped"]
    assert cold_start.NAME not in [row["name"] for row in found["choice"]["rows"]]
    assert found["choice"]["chosen"] in ("own offset", "constant")
    assert load_bundle(output).card.training["started_from"] == f"{started.model_id:08x}"


def test_few_configurations_start_from_the_simulator(tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "load", lambda *_: ("made up", dataset(6, 3, samples=157)))
    far_off = Candidate("far off", lambda data, seed: (LinePrior(9.0), None))
    monkeypatch.setattr(choosing, "standard", lambda recipe, alone: [far_off])
    output, result = tmp_path / "cold.onnx", tmp_path / "cold.json"
    done = run("train", "--data", tmp_path, "-o", output, "--folds", 2, "--json", result)
    assert done.exit_code == 0, done.output
    assert "kept unless another one is 10% better" in " ".join(done.output.split())
    # The mark stands in the chosen one's own line, at 80 columns too.
    assert [line for line in done.output.splitlines() if "->" in line and cold_start.NAME in line]
    found, made, start = (
        json.loads(result.read_text()),
        load_bundle(output),
        load_bundle(default_model_path()),
    )
    assert found["choice"]["chosen"] == made.card.training["chosen"] == cold_start.NAME
    mae = {row["name"]: row["mae"] for row in found["choice"]["rows"]}
    assert found["helped"] == (mae[choosing.NESTED] < mae["raw"])
    assert ("this did not help" in " ".join(done.output.split())) != found["helped"]
    assert set(found) == {"model_id", "n", "refused", "rows", "helped", "by_configuration", "choice"}
    assert made.card.training["started_from"] == f"{start.model_id:08x}"
    inputs = windows(5, 157)
    whole = floating.predict_m(float_network(start), inputs)
    assert floating.predict_m(float_network(made), inputs) == pytest.approx(whole, abs=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--data", "a", "--from-bag", "b"),
        ("--data", "a", "--truth", "c"),
        ("--data", "a", "--recipe", "best"),
        ("--from-bag", "b", "--recipe", "auto"),
        ("--from-bag", "b", "--samples", 157),
        ("--from-bag", "b", "--scaling", "max"),
        ("--from-bag", "b", "--first-kernel", 3),
        ("--from-bag", "b", "--per-configuration", 20),
        ("--from-bag", "b", "--no-prior"),
    ],
)
def test_contradictory_requests_are_refused(tmp_path, arguments):
    with pytest.raises(ParameterError):
        run_or_raise("train", *arguments, "-o", tmp_path / "x.onnx")


def test_what_does_not_go_with_a_bag_is_named(tmp_path):
    with pytest.raises(ParameterError, match=r"^--samples, --prior/--no-prior with --from-bag"):
        run_or_raise(
            "train", "--from-bag", "b", "--samples", 64, "--no-prior", "--seed", 1, "-o", tmp_path / "x.onnx"
        )


@pytest.mark.parametrize(
    ("configurations", "arguments", "message"),
    [
        (2, (), "^2 configurations, .*3 or more, .*`configuration`"),
        (3, ("--folds", 2), "^3 configurations, .*4 or more"),
        (1, ("--recipe", "line"), "^1 configuration, .*2 or more"),
    ],
)
def test_too_few_configurations_are_counted(tmp_path, monkeypatch, configurations, arguments, message):
    monkeypatch.setattr(parts, "load", lambda *_: ("made up", dataset(configurations, 3)))
    with pytest.raises(DatasetError, match=message):
        run_or_raise("train", "--data", tmp_path, "-o", tmp_path / "x.onnx", *arguments)


@pytest.mark.parametrize(("configurations", "folds"), [(3, 6), (4, 2), (4, 3), (5, 4), (7, 6)])
def test_as_many_configurations_as_are_asked_for_do(configurations, folds):
    assert configurations >= choosing.least_configurations(folds)
    choosing.choose(dataset(configurations, 2, samples=8), CONSTANTS, min(folds, configurations), 0)


def test_data_without_preamble_counts_is_told_of_the_other_scaling(tmp_path, monkeypatch):
    unknown = ranges_of_eight_places()
    for item in unknown:
        object.__setattr__(item.measurement.cir, "preamble_count", 0)
    truths = [Truth(3.0, configuration=f"{item.measurement.tag_id}") for item in unknown]
    unknown = [replace(item, truth=truth) for item, truth in zip(unknown, truths, strict=True)]
    monkeypatch.setattr(opening, "open_recording", lambda path: Recorded(unknown))
    tag = ("evaluate", "--data", "bag", "--cross-validate", "tag", "--scaling", "max")
    monkeypatch.setattr(
        comparison, "run", lambda data, *_: pytest.fail(data.preprocessing.scaling, pytrace=False)
    )
    with pytest.raises(pytest.fail.Exception, match="max"):
        run_or_raise(*tag)
    for command in (("train", "-o", tmp_path / "x.onnx"), ("evaluate", "--cross-validate", "configuration")):
        with pytest.raises(DatasetError, match="--scaling max"):
            run_or_raise(*command, "--data", "bag")
