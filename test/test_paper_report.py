"""The report: tables and figures of the paper for any labelled data, with missing measurements marked."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from command_line import run, succeed
from model_material import dataset

from benchmarks.paper import report, tables
from benchmarks.paper.report import Report, Study, build_report
from benchmarks.paper.results import ExperimentResults, FirmwareRow
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling

PARTS = ["method", "data", "table1", "table2", "search", "table3", "fig3", "fig4a", "fig4b", "fig5", "lr"]
HOSTILE = "<script>alert(1)</script>_$\\frac{$"


class Page(HTMLParser):
    """Elements of a page and the text of its sections; checks that every element is closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, list[str]] = {"": []}
        self._open: list[str] = []
        self._section = ""
        self.feed(html)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag == "section":
            self._section = dict(attributes)["id"]
            self.text[self._section] = []
        if tag not in ("meta", "img", "br", "link"):
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


def study(name: str = "logs", label: str = "LOS", configuration: str = "", simulated: bool = False) -> Study:
    data = dataset(3, 10)
    data = replace(
        data,
        labels=np.array([label if row % 2 else "NLOS" for row in range(len(data))]),
        configurations=np.array([f"{configuration}{one}" for one in data.configurations]),
        inputs=(data.inputs / data.inputs.max(axis=1, keepdims=True)).astype(np.float32),
        preprocessing=Preprocessing(data.inputs.shape[1], Scaling.MAX),
    )
    return Study(Path(name), name, simulated, data, "python -m benchmarks paper report")


def part(mae: float, mae_raw: float = 0.2) -> dict[str, object]:
    box = [-0.1, 0.0, 0.0625, 0.1, 0.2]
    return {
        "n": 10,
        "mae_raw": mae_raw,
        "sigma_raw": 0.1,
        "mae": mae,
        "sigma": 0.05,
        "box": box,
        "box_raw": box,
    }


def trained(network: str = "remnet", samples: int = 157, seed: int = 0, **changes: object) -> dict:
    maes = {"float": 0.0625 + 0.002 * seed, "optimised": 0.0625, "int8": 0.0635}
    errors = {
        form: {"all": part(mae), "los": part(0.0625), "nlos": part(0.0625)} for form, mae in maes.items()
    }
    sizes = {"float": 27825, "optimised": 28105, "int8": 23888 + 10 * seed, "zipped": 10000}
    which = {"network": network, "samples": samples, "seed": seed, "seconds": 60.0, "parameters": 5905}
    return which | {"errors": errors, "bytes": sizes} | changes


RANGE_TEST = {"rates": [1e-6, 1e-3, 1.0], "losses_m": [0.2, 0.1, 0.3], "falls_from": 1e-4, "falls_to": 1e-3}


def trial(stage: str, modules: int, mae: float, is_on_front: bool) -> dict[str, object]:
    shape = {"modules": modules, "first_kernel": 5, "kernel": 3, "filters": 16}
    costs = {"parameters": 5937, "multiply_accumulates": 1000 * modules}
    return {"stage": stage, "shape": shape, "mae": mae, "is_on_front": is_on_front} | costs


TRIALS = [
    trial("random", 3, 0.09, False),
    trial("random", 4, 0.095, False),
    trial("grid", 2, 0.08, True),
    trial("grid", 2, 0.08, True),
]


def results(*models: dict, epochs: int = 30, **changes: object) -> ExperimentResults:
    options = {
        "epochs": epochs,
        "learning_rate": 3e-4,
        "batch": 32,
        "dropout": 0.5,
        "weight_decay": 0,
        "seed": 0,
    }
    values = {"data": "logs", "split": "paper", "train": 30, "test": 10, "options": options, "models": models}
    return ExperimentResults.model_validate(values | changes)


def firmware_row() -> FirmwareRow:
    which = {"model": "remnet", "k": 157, "k0": 3, "kernels": "cortex_m4", "mismatches": 0, "inputs": 5000}
    memory = {"instructions": 389_000, "ram_bytes": 10_700, "flash_bytes": 17_600}
    return FirmwareRow.model_validate(which | memory | {"hz": 142.2, "energy_mj": 0.375})


def row_of(made: Report, table: str, *heads: str) -> tuple[tables.Cell, ...]:
    (found,) = (one for one in made.tables if one.id == table)
    return next(row for row in found.rows if [cell.text for cell in row[: len(heads)]] == list(heads))


@pytest.fixture(scope="module")
def full() -> Report:
    """Return the report of one network and one firmware measurement."""
    searched = {"range_test": RANGE_TEST, "trials": TRIALS}
    return build_report(
        study(simulated=True), results(trained(), trained("mlp"), **searched), [firmware_row()]
    )


@pytest.fixture
def no_cloud(monkeypatch):
    """Without Fig. 4, which takes most of the time."""
    monkeypatch.setattr(report.figures, "scatter", lambda *_: "data:image/png;base64,")


def test_page_contains_all_tables_and_figures_and_no_external_references(full):
    html = full.html()
    page = Page(html)
    assert sorted(values["id"] for values in page.all("section")) == sorted(PARTS)
    assert full.lacking == {}
    for part in PARTS[1:]:
        assert {"Data", "Split", "Seeds", "Command"} <= set(page.text[part])
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.elements}
    for _, values in page.elements:
        for name in ("src", "href"):
            assert values.get(name, "#").startswith(("data:image/", "#"))
    assert not re.search(r"url\(|@import|https?:", html)
    for image in page.all("img"):
        kind, content = image["src"].split(";base64,")
        data = base64.b64decode(content, validate=True)
        if kind == "data:image/png":
            assert data.startswith(b"\x89PNG")
            continue
        text = re.sub(r'xmlns(:\w+)?="[^"]*"|<!DOCTYPE.*?>', "", data.decode(), flags=re.DOTALL)
        assert not re.search(r'href="(?!#)|url\((?!#)|<script', text)
    assert all(len(image["alt"]) > 40 for image in page.all("img"))
    assert "simulated data" in page.text[""]


def test_missing_measurements_and_estimates_are_marked(full):
    for table in (table for table in full.tables if table.id.startswith("table")):
        assert table.has_gaps
        assert table.missing
    kinds = [cell.kind for cell in row_of(full, "table3", "REMNet", "157", "Cortex-M4")[8:11]]
    assert kinds == ["estimated", "estimated", "measured"]


def test_raw_errors_and_changes_are_next_to_those_of_the_paper(full):
    text = " ".join(Page(full.html()).text["method"])
    for excerpt in (
        "0.1242, 0.1642 0.2000, 0.1000",
        "-68.8 %",
        "1.0 times",
        "0.0001 to 0.001: the loss falls",
    ):
        assert excerpt in text


def test_simulated_results_are_marked_as_not_comparable(full):
    for table in ("data", "table1", "search"):
        assert "Simulated data, not comparable" in Page(full.html()).text[table]
    assert "Simulated data" not in build_report(study(), results(trained())).html()


def test_both_first_kernels_and_the_original_network_are_rows_of_table_1(full):
    for heads in (("REMNet", "157"), ("REMNet, k0 = 5", "157")):
        assert row_of(full, "table1", *heads)[3].value == 0.0687
    assert row_of(full, "table1", "REMNet with self-attention", "157")[7].kind == "missing"
    pruned = build_report(study(), results(trained(), trained("remnet_pruned_50", parameters=3033)))
    row = row_of(pruned, "table2", "REMNet, 50 % of weights pruned", "157")
    assert [row[2].value, row[-1].value] == [3033, 10.0]


def test_search_shows_the_front_and_the_choice_of_the_paper_by_operations(full):
    (table,) = (table for table in full.tables if table.id == "search")
    rows = [(row[0].text, row[1].value, row[-1].value) for row in table.rows]
    assert rows == [("grid, front", 2, 0.08), ("paper's choice", 3, 0.09)]
    assert table.note.startswith("3 networks")


def test_published_numbers_are_in_their_own_columns(full):
    for heads, expected in (
        (("table1", "MLP", "157"), [54401, 0.0769, 0.0777, 0.0775]),
        (("table2", "MLP", "157"), [216.047, 125.885, 60.320]),
        (("table3", "REMNet", "16", "Cortex-M4"), [140.0, 3.3, 15.6, 51.6, 0.37]),
    ):
        assert [cell.value for cell in row_of(full, *heads) if cell.kind == "paper"] == expected


def test_measured_numbers_are_means_over_seeds(no_cloud):
    made = build_report(study(), results(*(trained(seed=seed) for seed in range(3))))
    cell = row_of(made, "table1", "REMNet", "157")[7]
    assert (cell.kind, cell.n, cell.text) == ("measured", 3, "0.0645 ± 0.0020")
    assert (cell.value, cell.std) == (pytest.approx(0.0645), pytest.approx(0.002))
    row = row_of(made, "table2", "REMNet", "157")
    # kB; a spread of zero is not shown.
    assert [cell.text for cell in row[-4:-1]] == ["27.825", "28.105", "23.898 ± 0.010"]
    assert "K = 157: los 0.062 m" in made.figures[-1].alt


def test_baselines_are_below_the_networks(no_cloud):
    made = build_report(study(), results(trained(), median=dict.fromkeys(("all", "los", "nlos"), part(0.15))))
    assert row_of(made, "table1", "Median error of the training part")[7].value == 0.15
    assert row_of(made, "table1", "No correction")[7].value == 0.2


def test_hostile_names_are_only_text():
    made = study(HOSTILE, HOSTILE, HOSTILE)
    page = build_report(made, results(trained(network=HOSTILE), data=HOSTILE, split=HOSTILE)).html()
    assert not Page(page).all("script")
    assert "<script" not in page


def test_command_writes_the_page_and_rejects_wrong_files(apartment, tmp_path):
    log = sorted((apartment / "logs").glob("*.log*"))[0]
    words = ("paper", "report", "--data", log, "-o", "out", "--json", "out.json")
    succeed(*words, folder=tmp_path)
    assert Page((tmp_path / "out" / "report.html").read_text()).all("img")
    values = json.loads((tmp_path / "out.json").read_text())
    assert [one["id"] for one in values["figures"]] == ["fig3", "fig4a", "fig4b"]
    (tmp_path / "bench.json").write_text("{}")
    for option in (("--firmware", "bench.json"), ("--models", "nowhere")):
        refused = run("paper", "report", "--data", log, "-o", "other", *option, folder=tmp_path)
        assert refused.returncode == 1
        assert option[1] in refused.stderr
        assert not (tmp_path / "other").exists()
