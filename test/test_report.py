"""The report: every table and figure of the paper for any labelled data, honest about what was not measured."""

from __future__ import annotations

import base64
import inspect
import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bag_material import imported
from browser import Browser
from conftest import REPOSITORY
from model_material import dataset
from typer.testing import CliRunner

from uwb_mitigation.cli import app
from uwb_mitigation.commands.firmware import bench_firmware
from uwb_mitigation.dataset import Dataset
from uwb_mitigation.errors import DatasetError, UwbMitigationError
from uwb_mitigation.evaluation import paper, report, results, tables
from uwb_mitigation.evaluation.projection import principal_components
from uwb_mitigation.evaluation.splits import by_name
from uwb_mitigation.evaluation.study import Study, examples
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.sources.deepuwb import DeepUwbRecording

OF_THE_DATA = ["data", "fig3", "fig4a", "fig4b"]
PARTS = ["data", "table1", "table2", "table3", "fig3", "fig4a", "fig4b", "fig5"]
HOSTILE = "<script>alert(1)</script>"
OBSTACLES = ("0000000000", "1000000000", "0000001001", "0000000001")


class Page(HTMLParser):
    """What a page holds: its elements, and the text of its cells by section."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, list[str]] = {"": []}
        self._open: list[str] = []
        self._section = ""
        self.feed(html)
        self.close()
        assert not self._open, "every element is closed"

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.elements.append((tag, values))
        if tag == "section":
            self._section = values["id"]
            self.text[self._section] = []
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag
        if tag == "section":
            self._section = ""

    def handle_data(self, data):
        if data.strip():
            self.text[self._section].append(data.strip())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [values for name, values in self.elements if name == tag]


def deepuwb_bag(folder: Path, count: int = 60) -> Path:
    generator = np.random.default_rng(5)
    amplitudes = generator.random((count, 157)) * np.exp(-np.arange(157) / 20)
    frame = pd.DataFrame(
        {
            "CIR": [row / row.max() for row in amplitudes],
            "Error": generator.normal(0.1, 0.2, count),
            "Room": np.arange(count) % 5,
            "Obstacles": [OBSTACLES[row % 4] for row in range(count)],
        }
    )
    frame.to_pickle(folder / "dataset.pkl")
    return imported(DeepUwbRecording(folder / "dataset.pkl", trust=True), folder / "dataset.mcap")


def study(label: str = "LOS", configuration: str = "", **changes: object) -> Study:
    data = dataset(3, 10)
    labels = np.array([label if row % 2 else "NLOS" for row in range(len(data))])
    names = np.array([f"{configuration}{name}" for name in data.configurations])
    values = {name: getattr(data, name) for name in Dataset.__slots__} | {
        "labels": labels,
        "configurations": names,
    }
    return Study.of(
        str(changes.get("name", "made up")), bool(changes.get("simulated", False)), Dataset(**values)
    )


ROOMS = "simulated seed 1/deepuwb/room2/clear/placement "
COMMANDS = report.Commands("logs", "out")
ORIGIN = tables.Provenance("logs", "half", "0", "uwb-mitigation report")


def trained(
    network: str = "remnet", samples: int = 157, seed: int = 0, **changes: object
) -> dict[str, object]:
    part = {"n": 10, "mae_raw": 0.2, "sigma_raw": 0.1, "mae": 0.0625, "sigma": 0.05}
    return {
        "network": network,
        "samples": samples,
        "seed": seed,
        "parameters": 5905,
        "multiply_accumulates": 362_160,
        "mae_raw": 0.2,
        "mae_float": 0.0625 + 0.002 * seed,
        "mae_optimised": 0.0625,
        "mae_int8": 0.0635,
        "bytes_float": 27825,
        "bytes_optimised": 28105,
        "bytes_int8": 23888,
        "float_errors": dict.fromkeys(("all", "los", "nlos"), part),
        "int8_errors": dict.fromkeys(("all", "los", "nlos"), part),
        "calibration": "max",
        "calibration_mae": {"max": 0.05},
        "seconds": 60.0,
        "samples_per_s": 6000.0,
        **changes,
    }


def protocol(*models: dict[str, object], **changes: object) -> dict[str, object]:
    return {
        "data": "logs",
        "split": "paper",
        "train": 30,
        "test": 10,
        "options": options(),
        "models": list(models),
        **changes,
    }


def options(epochs: int = 30, learning_rate: float = 3e-4) -> dict[str, float]:
    fixed = {"batch": 32, "dropout": 0.5, "weight_decay": 0.0, "seed": 0}
    return {"epochs": epochs, "learning_rate": learning_rate} | fixed


def parsed(values: object) -> results.ExperimentResults:
    return results.parse(results.ExperimentResults, json.dumps(values), "here")


def baseline(name: str, mae: float | None, reason: str = "") -> dict[str, object]:
    part = {"n": 10, "mae_raw": 0.2, "sigma_raw": 0.1, "mae": mae, "sigma": 0.05}
    errors = None if mae is None else dict.fromkeys(("all", "los", "nlos"), part)
    return {"name": name, "errors": errors, "reason": reason}


def firmware_row(**changes: object) -> dict[str, object]:
    return {
        "model": "remnet",
        "k": 157,
        "k0": 3,
        "kernels": "cortex_m4",
        "instructions": 389_000,
        "cycles_estimated": 450_000,
        "ram_bytes": 10_700,
        "flash_bytes": 17_600,
        "mismatches": 0,
        "inputs": 5000,
        "hz": 142.2,
        "energy_mj": 0.375,
        **changes,
    }


def tabled(name: str, *models: dict[str, object], firmware: tuple[dict[str, object], ...] = ()) -> dict:
    """One of the paper's tables, as JSON."""
    trainings = parsed(protocol(*models))
    made = {
        "table1": lambda: tables.accuracy(trainings, ORIGIN, "uwb-mitigation protocol"),
        "table2": lambda: tables.sizes(trainings, ORIGIN, "uwb-mitigation protocol"),
        "table3": lambda: tables.firmware(
            results.parse_firmware(json.dumps({"rows": list(firmware)}), "here"),
            ORIGIN,
            "uwb-mitigation bench",
        ),
    }[name]()
    return json.loads(json.dumps(made.as_json()))


def row_of(table: dict, *heads: str) -> list[dict]:
    return next(row for row in table["rows"] if [cell["text"] for cell in row[: len(heads)]] == list(heads))


def run(*words: object) -> object:
    return CliRunner().invoke(app, [str(word) for word in ("report", *words)])


@pytest.fixture(scope="module")
def deepuwb(tmp_path_factory) -> tuple[str, dict]:
    """Page and JSON of a DeepUWB-shaped bag, nothing trained."""
    folder = tmp_path_factory.mktemp("deepuwb")
    words = [
        "--data",
        deepuwb_bag(folder),
        "-o",
        folder / "out",
        "--simulated",
        "--json",
        folder / "out.json",
    ]
    result = run(*words)
    assert result.exit_code == 0, result.output
    return (folder / "out" / "report.html").read_text(), json.loads((folder / "out.json").read_text())


@pytest.fixture(scope="module")
def full() -> report.Report:
    """The report of trainings and a bench; most of both is there."""
    firmware = results.parse_firmware(json.dumps({"rows": [firmware_row()]}), "here")
    trainings = parsed(protocol(trained()))
    return report.build(study(simulated=True), COMMANDS, trainings, {157: np.zeros(9)}, firmware)


@pytest.fixture(scope="module")
def plain() -> str:
    """The page of a study without rooms."""
    return report.build(study(), COMMANDS).html()


@pytest.fixture
def without_clouds(monkeypatch) -> None:
    """Leaves out Fig. 4, which takes most of the time, where a test looks elsewhere."""
    monkeypatch.setattr(report.figures, "scatter", lambda *_: "data:image/png;base64,")


def test_every_table_and_figure_of_the_paper_is_there(full):
    page = Page(full.html())
    assert [values["id"] for values in page.all("section")] == PARTS
    assert len(page.all("table")) == 4
    assert len(page.all("img")) == 4
    assert full.lacking == full.to_fill == ""


@pytest.mark.parametrize(
    ("given", "lacking", "to_fill"),
    [
        (
            {},
            "Tables 1 and 2, Fig. 5; Table 3",
            "uwb-mitigation protocol --data logs -o models --networks remnet,mlp"
            " && uwb-mitigation bench firmware --json firmware.json"
            " && uwb-mitigation report --data logs -o out --models models --firmware firmware.json",
        ),
        (
            {"trainings": True},
            "Table 3",
            "uwb-mitigation bench firmware --json firmware.json"
            " && uwb-mitigation report --data logs -o out --models 'of mine' --firmware firmware.json",
        ),
    ],
)
@pytest.mark.usefixtures("without_clouds")
def test_what_there_are_no_results_for_is_left_out_and_one_line_says_what_to_run(given, lacking, to_fill):
    trainings = parsed(protocol(trained())) if given else None
    commands = replace(COMMANDS, models="of mine" if given else None)
    made = report.build(study(), commands, trainings)
    assert (made.lacking, made.to_fill) == (lacking, to_fill)
    page = Page(made.html())
    assert "table3" not in page.text
    assert ("table1" in page.text, "fig5" in page.text) == (bool(given),) * 2
    assert to_fill in page.text[""]


def test_real_logs_alone_give_what_is_made_of_data(apartment, tmp_path):
    logs = sorted((apartment / "logs").glob("*.log*"))[:1]
    result = run("--data", logs[0], "-o", tmp_path)
    assert result.exit_code == 0, result.output
    assert "uwb-mitigation protocol" in result.output
    page = Page((tmp_path / "report.html").read_text())
    assert [values["id"] for values in page.all("section")] == OF_THE_DATA
    assert len(page.all("img")) == 3


def test_the_page_refers_to_nothing_outside_itself(deepuwb):
    page = Page(deepuwb[0])
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.elements}
    for _, values in page.elements:
        for name in ("src", "href"):
            assert values.get(name, "#").startswith(("data:image/", "#"))
    assert not re.search(r"url\(|@import|https?:", deepuwb[0])


def test_images_are_whole_and_refer_to_nothing_either(deepuwb):
    for image in Page(deepuwb[0]).all("img"):
        kind, content = image["src"].split(";base64,")
        data = base64.b64decode(content, validate=True)
        if kind == "data:image/png":
            assert data.startswith(b"\x89PNG")
            continue
        assert kind == "data:image/svg+xml"
        text = re.sub(r'xmlns(:\w+)?="[^"]*"|<!DOCTYPE.*?>', "", data.decode(), flags=re.DOTALL)
        assert not re.search(r'href="(?!#)|url\((?!#)|<script', text)


def test_the_page_can_be_read_without_seeing_it(full):
    page = Page(full.html())
    assert page.all("html")[0]["lang"] == "en"
    assert all(values.get("scope") for values in page.all("th"))
    assert len([tag for tag, _ in page.elements if tag == "caption"]) == 4
    assert all(len(image["alt"]) > 40 for image in page.all("img"))


def test_each_table_and_figure_names_data_split_seeds_and_command(full):
    page = Page(full.html())
    for part in PARTS:
        assert {"Data", "Split", "Seeds", "Command"} <= set(page.text[part])
        assert any(text.startswith("uwb-mitigation ") for text in page.text[part])


def test_fewer_networks_than_the_papers_are_called_a_quick_look(full):
    (notice,) = [notice for notice in full.notices if notice.startswith("A quick look")]
    assert re.search(r"\d seeds? of 5 and \d of 6 lengths", notice)


def test_a_quick_bench_of_the_firmware_is_told_as_it_was_run():
    assert inspect.signature(bench_firmware).parameters["inputs"].default == report.BENCH_INPUTS
    row = results.FirmwareRow.model_construct(kernels="cortex_m4", inputs=200)
    quick = "uwb-mitigation bench firmware --inputs 200 --no-portable --json firmware.json"
    assert COMMANDS.bench_of([row]) == quick
    whole = [
        row.model_copy(update={"inputs": 5000}),
        row.model_copy(update={"kernels": "portable", "inputs": 100}),
    ]
    assert COMMANDS.bench_of(whole) == COMMANDS.bench == "uwb-mitigation bench firmware --json firmware.json"


@pytest.mark.parametrize("width", [1280, 400])
def test_nothing_is_cut_off(browser: Browser, full, tmp_path: Path, width: int):
    (tmp_path / "report.html").write_text(full.html(), encoding="utf-8")
    browser.open((tmp_path / "report.html").as_uri(), width)
    assert browser.cut_off(width) == []
    assert browser.complaints() == []
    browser.screenshot(f"report_{width}")


def test_data_of_a_radio_is_not_called_simulated(plain):
    assert "simulated" not in plain.split("</style>")[1].lower()


def test_simulated_data_is_called_so(deepuwb, full):
    page, values = deepuwb
    assert values["simulated"] is True
    assert "simulated data" in Page(page).text[""]
    assert "(simulated)" in values["data"]
    for part in ("data", "table1"):
        assert "Measured on simulated data" in Page(full.html()).text[part]
    assert any("DeepUWB's shape and none of its radio" in notice for notice in values["notices"])


def test_the_same_data_gives_the_same_page(plain):
    assert report.build(study(), COMMANDS).html() == plain


def test_what_was_not_measured_says_so_and_how_to_measure_it(full):
    values = json.loads(json.dumps(full.as_json()))
    for found in values["tables"][1:]:
        assert found["has_gaps"]
        assert found["missing"].startswith("uwb-mitigation ")
        own = [cell for row in found["rows"] for cell in row if cell["kind"] == "missing"]
        assert own
        assert all(cell["text"] == "not measured" and cell["value"] is None for cell in own)
    assert "not measured" in Page(full.html()).text["table3"]


def test_the_papers_numbers_stand_in_its_own_columns():
    first, *_ = row_of(tabled("table1"), "REMNet", "157")[2:]
    assert (first["kind"], first["value"]) == ("paper", 5905)
    row = row_of(tabled("table1"), "MLP", "157")
    assert [cell["value"] for cell in row if cell["kind"] == "paper"] == [54401, 0.0769, 0.0777, 0.0775]
    row = row_of(tabled("table3"), "REMNet", "16", "Cortex-M4")
    assert [cell["value"] for cell in row if cell["kind"] == "paper"] == [140.0, 3.3, 15.6, 51.6, 0.37]


def test_accuracy_is_the_mean_over_seeds():
    row = row_of(tabled("table1", *(trained(seed=seed) for seed in range(3))), "REMNet", "157")
    cell = row[7]
    assert (cell["kind"], cell["n"]) == ("measured", 3)
    assert cell["value"] == pytest.approx(0.0645)
    assert cell["std"] == pytest.approx(0.002)
    assert cell["text"] == "0.0645 ± 0.0020"


def test_what_needs_no_network_stands_below_the_networks():
    values = protocol(trained(), baselines=[baseline("overall_median", 0.15), baseline("line", 0.125)])
    table = tables.accuracy(parsed(values), ORIGIN, "uwb-mitigation protocol")
    rows = {row[0].text: row[7] for row in table.rows}
    assert rows["L1 line"].value == 0.125
    assert rows["Median error"].value == 0.15
    assert rows["No correction"].value == 0.2
    assert rows["Median error in LOS"].kind == "missing"


def test_a_line_that_the_data_does_not_allow_is_said_and_not_called_unmeasured():
    values = protocol(trained(), baselines=[baseline("line", None, "the data has no received power")])
    table = tables.accuracy(parsed(values), ORIGIN, "uwb-mitigation protocol")
    (line,) = (row for row in table.rows if row[0].text.startswith("L1 line"))
    assert line[7].kind == "none"
    assert "the data has no received power" in table.note


def test_a_form_that_a_network_does_not_have_is_not_called_unmeasured():
    attention = trained("remnet_attention", mae_int8=None, bytes_int8=None, int8_errors=None)
    row = row_of(tabled("table1", attention), "REMNet with attention", "157")
    assert [cell["kind"] for cell in row[-2:]] == ["measured", "none"]


def test_sizes_are_in_kilobytes():
    row = row_of(tabled("table2", trained()), "REMNet", "157")
    assert [cell["text"] for cell in row[-3:]] == ["27.825", "28.105", "23.888"]


def test_a_spread_that_rounds_to_nothing_is_not_shown():
    models = [
        trained(seed=seed, bytes_float=27825 + seed // 4, bytes_int8=23888 + 10 * seed) for seed in range(5)
    ]
    row = row_of(tabled("table2", *models), "REMNet", "157")
    assert [cell["text"] for cell in row[-3:]] == ["27.825", "28.105", "23.908 ± 0.016"]


def test_rates_and_energy_of_the_emulator_are_called_estimated():
    found = tabled("table3", firmware=(firmware_row(),))
    row = row_of(found, "REMNet", "157", "Cortex-M4")
    assert [cell["kind"] for cell in row[8:10]] == ["estimated", "estimated"]
    assert row[10]["kind"] == "measured"
    assert found["groups"][1][0] == "Estimated"


@pytest.mark.usefixtures("without_clouds")
def test_the_box_plot_shows_the_errors_that_are_given():
    errors = np.linspace(-1, 1, 201)
    trainings = parsed(protocol(trained()))
    picture = report.build(study(), COMMANDS, trainings, {157: errors}).pictures[-1]
    box = picture.as_json()["numbers"]["errors"]["157"]
    assert [box[name] for name in ("low", "first", "median", "third", "high")] == pytest.approx(
        [-0.9, -0.5, 0, 0.5, 0.9]
    )
    assert "K = 157: los 0.062 m" in picture.alt
    assert "K = 64: not measured" in picture.alt


@pytest.mark.usefixtures("without_clouds")
def test_networks_trained_shorter_than_the_papers_are_told():
    trainings = parsed(protocol(trained(), options=options(epochs=2)))
    result = report.build(study(), COMMANDS, trainings)
    assert any("2 epochs" in notice for notice in result.notices)
    assert result.tables[1].provenance.seeds == "0; 2 epochs each"
    assert "--seeds 1 --epochs 2" in result.tables[1].provenance.command


@pytest.mark.parametrize(
    ("names", "what"),
    [
        (["deepuwb/room2/wall", "deepuwb/room1/clear"], "room and materials"),
        ([ROOMS + "1", ROOMS + "2"], "placements of both antennas"),
        (["1", "2"], "placements of both antennas"),
    ],
)
@pytest.mark.usefixtures("without_clouds")
def test_a_configuration_is_what_the_data_tells_of_it(names: list[str], what: str):
    data = study().dataset
    named = replace(data, configurations=np.array([names[row % 2] for row in range(len(data))]))
    result = report.build(Study.of("made up", False, named), COMMANDS)
    assert f"2 configurations ({what})" in result.tables[0].note


@pytest.mark.usefixtures("without_clouds")
@pytest.mark.parametrize(
    ("configuration", "values", "words"),
    [
        (ROOMS, {"split": "paper"}, ""),
        (ROOMS, {"split": "all_but_room_2"}, " --split all_but_room_2"),
        (ROOMS, {"split": "configurations: 1 of 4 parts held out"}, " --split configurations"),
        ("", {"split": "configurations: 1 of 4 parts held out"}, ""),
        # A quick one of `report`: no option of the protocol gives it.
        ("", {"split": "by configuration: 1 of 3 held out"}, ""),
        (ROOMS, {"options": options(learning_rate=0.001)}, " --learning-rate 0.001"),
        (ROOMS, {"models": [trained(samples=8, seed=seed) for seed in range(5)]}, " --windows 8"),
        (ROOMS, {"models": [trained("mlp", 8, seed) for seed in range(5)]}, " --windows 8"),
        (ROOMS, {"models": [trained("mlp", 157, seed) for seed in range(5)]}, ""),
    ],
)
def test_the_command_names_what_is_not_the_protocols_own(configuration, values, words):
    every = [trained(samples=samples, seed=seed) for samples in paper.WINDOWS for seed in range(5)]
    trainings = parsed(protocol(*every) | values)
    made = study()
    if configuration:
        names = np.array([f"{configuration}{row // 10}" for row in range(len(made.dataset))])
        made = Study.of("made up", True, replace(made.dataset, configurations=names))
    command = report.build(made, COMMANDS, trainings).tables[1].provenance.command
    networks = ",".join(dict.fromkeys(model.network for model in trainings.models))
    assert command == f"uwb-mitigation protocol --data logs -o models --networks {networks}{words}"


@pytest.mark.parametrize("name", [HOSTILE + "_$\\frac{$", "_\ud800\x00\n\u202e漢字" + "a" * 500])
def test_hostile_names_are_text_and_nothing_else(name: str):
    hostile = study(label=name, configuration=name, name=name)
    whole = name.encode("utf-8", "replace").decode()  # half a surrogate is no JSON
    trainings = parsed(protocol(trained(network=whole), data=whole, split=whole))
    page = report.build(hostile, report.Commands(name, name), trainings).html()
    page.encode("utf-8")
    assert not Page(page).all("script")
    assert not re.search(r"<script|[\x00\u202e]", page)


def test_a_path_with_spaces_can_be_pasted_into_a_shell():
    assert (
        report.Commands("my logs; rm -rf", "out").report
        == "uwb-mitigation report --data 'my logs; rm -rf' -o out"
    )


@pytest.mark.parametrize(
    "values",
    [
        None,
        [],
        {},
        protocol(trained(), trained()),
        protocol(trained(mae_float=float("nan"))),
        protocol(trained(mae_float=10**400)),
        protocol(trained(samples="157")),
        protocol(trained(samples=1.5)),
        protocol(trained(float_errors=None, int8_errors=None)),
        protocol(models=7),
        protocol(baselines=[{"name": "line"}]),
        protocol(baselines=[baseline("line", 0.1) | {"errors": {"los": {}}}]),
        protocol(7),
        protocol(data=3),
    ],
    ids=str,
)
def test_results_that_are_none_are_refused(values):
    with pytest.raises(DatasetError, match="here"):
        parsed(values)


@pytest.mark.parametrize("content", ["", "[1", "[" * 100_000, "{}"])
def test_damaged_result_files_are_refused_by_name(content: str, tmp_path):
    (tmp_path / "bench.json").write_text(content)
    result = run(
        "--data", deepuwb_bag(tmp_path), "-o", tmp_path / "out", "--firmware", tmp_path / "bench.json"
    )
    assert isinstance(result.exception, UwbMitigationError)
    assert "bench.json" in str(result.exception)
    assert not (tmp_path / "out" / "report.html").exists()


def test_models_that_are_not_there_are_refused(tmp_path):
    result = run("--data", deepuwb_bag(tmp_path), "-o", tmp_path / "out", "--models", tmp_path)
    assert isinstance(result.exception, UwbMitigationError)
    assert "protocol.json" in str(result.exception)


@pytest.mark.usefixtures("without_clouds")
def test_quick_training_fills_tables_and_boxes(tmp_path, monkeypatch):
    monkeypatch.setattr("uwb_mitigation.training.experiment.QUICK_EPOCHS", 1)
    monkeypatch.setattr("uwb_mitigation.evaluation.paper.WINDOWS", (16, 8))
    data, target = deepuwb_bag(tmp_path), tmp_path / "out.json"
    result = run("--data", data, "-o", tmp_path / "out", "--train", "quick", "--json", target)
    assert result.exit_code == 0, result.output
    values = json.loads(target.read_text())
    row = row_of(values["tables"][1], "REMNet", "8")
    assert [cell["kind"] for cell in row[-3:]] == ["measured"] * 3
    assert set(values["figures"][-1]["numbers"]["errors"]) == {"16", "8"}
    assert "the data has no received power" in values["tables"][1]["note"]
    assert any("--train quick" in notice for notice in values["notices"])


def test_a_missing_matplotlib_is_named_with_its_remedy():
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from uwb_mitigation.errors import MissingDependencyError\n"
        "try:\n    import uwb_mitigation.evaluation.report\n"
        "except MissingDependencyError as error:\n    print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=REPOSITORY, capture_output=True, text=True
    )
    assert "matplotlib" in done.stdout
    assert "make setup-training" in done.stdout


def test_components_are_those_of_the_covariance():
    generator = np.random.default_rng(0)
    inputs = generator.normal(size=(200, 6)) * (5, 3, 2, 1, 1, 1) + 7
    projection = principal_components(inputs)
    values = np.sort(np.linalg.eigvalsh(np.cov(inputs.T)))[::-1]
    assert projection.points.var(axis=0, ddof=1) == pytest.approx(values[:3])
    assert projection.explained == pytest.approx(values[:3] / values.sum())
    assert principal_components(-inputs).points.std() == pytest.approx(projection.points.std())


@pytest.mark.parametrize("shape", [(1, 157), (2, 157), (5, 1)])
def test_components_that_the_data_does_not_have_are_zero(shape):
    projection = principal_components(np.ones(shape, np.float32))
    assert projection.points.shape == (shape[0], 3)
    assert not projection.points.any()
    assert not projection.explained.any()


def test_examples_show_los_first_and_the_median_of_each_kind():
    chosen = examples(study())
    assert [one.label for one in chosen] == ["LOS", "NLOS"]
    data = study()
    rows = data.labels == "LOS"
    errors = np.sort(data.dataset.error_m[rows])
    assert chosen[0].error_m == errors[(rows.sum() - 1) // 2]
    assert chosen[0].amplitudes.max() == 1


def test_errors_of_other_rows_are_never_shown_as_those_of_the_test_part():
    data = Study.of("made up", False, dataset(4, 10))
    rows = by_name(data.dataset.configurations, "auto")[1].test
    raw = float(np.abs(data.dataset.error_m[rows]).mean())
    assert np.array_equal(data.test_rows(len(rows), raw), rows)
    assert data.test_rows(len(rows), raw + 0.01) is None
    assert data.test_rows(len(rows) + 1, raw) is None


def test_windows_scaled_by_the_preamble_count_give_those_scaled_by_the_maximum():
    data = study()
    rows = np.arange(4)
    windows = data.window(rows, Preprocessing(16, Scaling.MAX))
    magnitudes = data.dataset.inputs[rows, :16].astype(float) ** 2
    assert data.dataset.preprocessing.scaling is Scaling.PREAMBLE
    assert windows == pytest.approx(magnitudes / magnitudes.max(axis=1, keepdims=True), rel=1e-5)
