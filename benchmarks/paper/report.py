"""Create a report with the tables and figures of the paper for one recording, next to the published numbers."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper import figures, published, tables
from benchmarks.paper.data import TEST_ROOM
from benchmarks.paper.results import (
    Box,
    ExperimentResults,
    FirmwareRow,
    PartErrors,
    RangeTest,
    Spread,
)
from benchmarks.paper.rooms import ROOM_ROWS, has_rooms, parse_configuration
from benchmarks.paper.tables import Cell, Provenance, ReportTable
from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.deepuwb import ROOMS

LOS = "LOS"
MAX_SAMPLES = 3
"""Number of conditions that Fig. 3 shows."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure.

    Attributes:
        alt: alternative text for screen readers.
        note: how to read it; `paper_note`: what the paper's figure shows.
        uri: the image as a `data:` URI.
    """

    id: str
    title: str
    alt: str
    note: str
    paper_note: str
    uri: str
    provenance: Provenance


@dataclass(frozen=True, slots=True)
class Report:
    """The page.

    Attributes:
        command: command that created this report.
        lacking: {missing parts: command that creates their results}.
        statements: measured values of numbers in the paper's text.
    """

    data: str
    simulated: bool
    command: str
    lacking: dict[str, str]
    notices: tuple[str, ...]
    statements: dict[str, str]
    tables: tuple[ReportTable, ...]
    figures: tuple[Picture, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the content without images."""
        content = asdict(self)
        for picture in content["figures"]:
            del picture["uri"]
        return content

    def html(self) -> str:
        """Return one page without external resources.

        Raises:
            MissingDependencyError: jinja2 is not installed.
        """
        try:
            import jinja2
        except ModuleNotFoundError as error:
            raise MissingDependencyError(
                "a report's page needs jinja2", valid="run `make setup-training`"
            ) from error
        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return environment.get_template("report.html.j2").render(report=self) + "\n"


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Labelled data with windows of the largest K, scaled by their maximum; `command` created the report from `path`."""

    path: Path
    name: str
    simulated: bool
    dataset: Dataset
    command: str

    @property
    def has_rooms(self) -> bool:
        """Whether the configurations contain rooms."""
        return has_rooms(self.dataset.configurations)

    @property
    def labels(self) -> NDArray[np.str_]:
        """Propagation condition of each row."""
        return np.where(self.dataset.labels == "", "no label", self.dataset.labels)

    @property
    def rooms(self) -> NDArray[np.str_]:
        """Room of each row, or the configuration if the data has no rooms."""
        names = self.dataset.configurations
        return (
            _map_names(names, lambda name: ROOMS[parse_configuration(name)[0]]) if self.has_rooms else names
        )

    @property
    def materials(self) -> NDArray[np.str_]:
        """Material between the antennas of each row, or the label if the data does not contain it."""
        return _map_names(self.dataset.configurations, _material) if self.has_rooms else self.labels

    def provenance(self, seeds: str = "none") -> Provenance:
        """Return the provenance of a table of all measurements."""
        return Provenance(self.name, "none: all measurements", seeds, self.command)


def _map_names(names: NDArray[np.str_], shown: Callable[[str], str]) -> NDArray[np.str_]:
    unique, inverse = np.unique(names, return_inverse=True)
    return np.array([shown(str(name)) for name in unique])[inverse]


def _material(configuration: str) -> str:
    materials = parse_configuration(configuration)[1]
    return "none (LOS)" if not materials else materials[0] if len(materials) == 1 else "several"


def build_report(
    study: Study, trainings: ExperimentResults | None = None, firmware: Sequence[FirmwareRow] = ()
) -> Report:
    """Return every table and figure that the data, the trainings and the firmware results allow."""
    train = f"python -m benchmarks paper protocol --data {shlex.quote(str(study.path))} -o models"
    bench = "python -m benchmarks firmware --json firmware.json"
    lacking: dict[str, str] = {}
    shown, pictures = (
        [_data_table(study)],
        [_samples(study), *(_components(study, letter) for letter in "ab")],
    )
    if trainings is None:
        lacking["Tables 1 and 2, Fig. 5"] = train
    else:
        seeds = sorted({model.seed for model in trainings.models})
        trained = Provenance(
            trainings.data,
            f"{trainings.split}; {trainings.train:,} training and {trainings.test:,} test measurements",
            f"{', '.join(map(str, seeds)) or 'none'}; {trainings.options.epochs} epochs each",
            trainings.command or train,
        )
        shown.append(tables.accuracy(trainings, trained, train, _measured(study)))
        shown.append(tables.sizes(trainings, trained, train))
        pictures.append(_over_k(trainings, trained))
        if trainings.trials and trainings.range_test:
            shown.append(tables.search(trainings, trained, _measured(study)))
            pictures.append(_range_test(trainings.range_test, trained))
    if firmware:
        random = "fixed, for windows and random weights; the cost does not depend on them"
        windows, split = "windows that test every rounding", "none: no accuracy is measured"
        shown.append(tables.firmware(firmware, Provenance(windows, split, random, bench), bench))
    else:
        lacking["Table 3"] = bench
    texts = _notices(study, trainings), tables.statements(trainings) if trainings else {}
    return Report(study.name, study.simulated, study.command, lacking, *texts, tuple(shown), tuple(pictures))


def _measured(study: Study) -> str:
    return "Simulated data, not comparable" if study.simulated else "Measured"


def _notices(study: Study, trainings: ExperimentResults | None) -> tuple[str, ...]:
    notices = []
    rows = tuple(int((study.rooms == room).sum()) for room in ROOMS)
    if study.simulated:
        notices.append("The data is simulated. It does not show the accuracy at a real site.")
    if study.simulated or not study.has_rooms or rows != ROOM_ROWS:
        notices.append(
            "The data is not the published DeepUWB: its results cannot be compared with the numbers of the paper."
        )
    if trainings is not None:
        seeds = len({model.seed for model in trainings.models})
        lengths = len({model.samples for model in trainings.models} & set(published.WINDOWS))
        epochs = trainings.options.epochs
        if epochs < published.EPOCHS or seeds < published.SEEDS or lengths < len(published.WINDOWS):
            notices.append(
                f"Shortened training: {epochs} epochs (paper: {published.EPOCHS}), {seeds} of {published.SEEDS} seeds, "
                f"{lengths} of {len(published.WINDOWS)} lengths of the CIR. Accuracies are not comparable with the paper's."
            )
    if study.dataset.skipped:
        reasons = ", ".join(f"{count:,} x {why}" for why, count in sorted(study.dataset.skipped.items()))
        notices.append(f"Skipped measurements: {reasons}.")
    return tuple(notices)


def _data_table(study: Study) -> ReportTable:
    labels = study.labels

    def row(name: str, selected: NDArray[np.bool_], published_rows: int | None = None) -> tuple[Cell, ...]:
        raw_errors = PartErrors.of(study.dataset.error_m[selected], study.dataset.error_m[selected])
        is_test_room = name == ROOMS[TEST_ROOM]
        return (
            Cell(name, "head"),
            tables.number_cell(published_rows, "{:,}", "paper"),
            *tables.number_cells(
                (published.RAW_MAE_M, published.RAW_SIGMA_M) if is_test_room else (None, None),
                "{:.4f}",
                "paper",
            ),
            tables.number_cell(raw_errors.n, "{:,}", "measured"),
            *tables.number_cells((raw_errors.mae_raw, raw_errors.sigma_raw), "{:.4f}", "measured"),
        )

    rows = []
    if study.has_rooms:
        rows = [row(room, study.rooms == room, count) for room, count in zip(ROOMS, ROOM_ROWS, strict=True)]
    names = sorted(np.unique(labels).tolist(), key=lambda name: (name != LOS, name))
    rows += [row(f"label {name}", labels == name) for name in names]
    rows.append(row("all", np.ones(len(labels), np.bool_), sum(ROOM_ROWS) if study.has_rooms else None))
    return ReportTable(
        "data",
        "The data before any correction",
        "MAE and standard deviation of the range error, measured minus true. "
        f"{len(study.dataset.names):,} configurations. Rows of DeepUWB: as published.",
        (("Paper and DeepUWB", 3), (_measured(study), 3)),
        ("Part", *(["Measurements", "MAE, m", "σ, m"] * 2)),
        1,
        tuple(rows),
        study.provenance(),
    )


def _samples(study: Study) -> Picture:
    labels, errors = study.labels, study.dataset.error_m
    # LOS first, then the most frequent conditions.
    names = sorted(np.unique(labels).tolist(), key=lambda name: (name != LOS, -(labels == name).sum()))
    selected = []
    for name in names[:MAX_SAMPLES]:
        rows = np.flatnonzero(labels == name)
        median = rows[np.argsort(errors[rows], kind="stable")[(len(rows) - 1) // 2]]
        selected.append((name, float(errors[median]), study.dataset.inputs[median]))
    described = "; ".join(f"{name}, range error {error:+.3f} m" for name, error, _ in selected)
    return Picture(
        "fig3",
        "Fig. 3. LOS and NLOS samples",
        f"Channel impulse responses over time, one panel each: {described}.",
        "The measurement with the median range error of each condition; amplitude relative to the maximum of the window. "
        "Dashed: first path reported by the radio.",
        "one LOS and one NLOS sample with normalised amplitude; in NLOS the signal arrives over many paths, "
        "and the range is biased upward.",
        figures.samples(selected),
        study.provenance(),
    )


def principal_components(inputs: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project inputs (n, k) onto the three directions of their largest variance.

    Returns:
        Coordinates (n, 3) and the share of the variance along each, (3,). Components that the data does not have are 0.

    Raises:
        ImportError: scikit-learn is not installed.
    """
    points, explained = np.zeros((len(inputs), 3)), np.zeros(3)
    count = min(3, *inputs.shape)
    if np.ptp(inputs, axis=0).any():
        from sklearn.decomposition import PCA

        analysis = PCA(count, svd_solver="full")
        points[:, :count] = analysis.fit_transform(inputs.astype(np.float64))
        explained[:count] = analysis.explained_variance_ratio_
    return points, explained


def _components(study: Study, letter: str) -> Picture:
    points, explained = principal_components(study.dataset.inputs)
    percentages = " + ".join(f"{100 * fraction:.0f}" for fraction in explained)
    selected = np.arange(len(points))
    if len(selected) > figures.MAX_POINTS:
        selected = np.sort(np.random.default_rng(0).choice(len(selected), figures.MAX_POINTS, replace=False))
    kinds = ("room", "material") if study.has_rooms else ("configuration", "label")
    kind, groups = kinds["ab".index(letter)], study.rooms if letter == "a" else study.materials
    return Picture(
        f"fig4{letter}",
        f"Fig. 4{letter}. Principal components, by {kind}",
        f"Three-dimensional scatter plot of {len(selected)} channel impulse responses along their first three principal "
        f"components, from two sides, coloured by {kind} ({len(np.unique(groups))} groups).",
        f"{len(selected):,} of {len(points):,} windows of {study.dataset.inputs.shape[1]} amplitudes. "
        f"The components contain {percentages} % of the variance.",
        "the three indoor rooms lie close together, apart from outdoor and through-the-wall measurements."
        if letter == "a"
        else "materials lie in different regions; heavier ones, such as metal, are concentrated and distant "
        "from plastic and wood.",
        figures.scatter(points[selected], groups[selected], f"By {kind}"),
        study.provenance("0, for the choice of points" if len(selected) < len(points) else "none"),
    )


def _over_k(trainings: ExperimentResults, provenance: Provenance) -> Picture:
    spreads: dict[int, dict[str, Spread]] = {}
    boxes: dict[str, Box | None] = {}
    if trainings.models:
        first = trainings.models[0].final_errors
        boxes = {f"raw\n{name}": getattr(first, name.lower()).box_raw for name in ("all", LOS, "NLOS")}
    for samples in published.WINDOWS:
        models = trainings.of("remnet", samples)
        values = {
            "los": Spread.of([model.final_errors.los.mae for model in models]),
            "nlos": Spread.of([model.final_errors.nlos.mae for model in models]),
            "sigma": Spread.of([model.final_errors.all.sigma for model in models]),
        }
        if models:
            spreads[samples] = {name: spread for name, spread in values.items() if spread is not None}
        model_boxes = [box for model in models if (box := model.final_errors.all.box)]
        boxes[f"K = {samples}"] = tuple(np.mean(model_boxes, axis=0).tolist()) if model_boxes else None
    paper_mae = {k: row.mae_m[2] for (network, k), row in published.MODELS.items() if network == "remnet"}
    described = "; ".join(
        f"K = {samples}: " + ", ".join(f"{name} {spread.mean:.3f} m" for name, spread in spread_of.items())
        for samples, spread_of in spreads.items()
    )
    return Picture(
        "fig5",
        "Fig. 5. Errors for each length of the CIR",
        "Above, box plot of range errors before correction and after REMNet for each K; below, bars of LOS MAE, "
        f"NLOS MAE and sigma. {described or 'No REMNet was trained'}.",
        "REMNet on the test part, int8 if it was quantised; quantiles are means over seeds. Grey: before correction. "
        "Black: the paper's int8 MAE (Table 1).",
        "errors grow as K falls, and K = 8 is the smallest acceptable length; the paper prints no numbers for it.",
        figures.over_k(boxes, spreads, paper_mae, published.WINDOWS),
        provenance,
    )


def _range_test(result: RangeTest, provenance: Provenance) -> Picture:
    rate = published.LEARNING_RATE
    return Picture(
        "lr",
        "Range test of the learning rate",
        f"Line plot of the training loss over the learning rate: it falls from {result.falls_from:.1g} to {result.falls_to:.1g}.",
        f"The rate increases with every batch (Smith 2017). The loss falls between {result.falls_from:.1g} and {result.falls_to:.1g}; "
        "running mean of the MAE of five REMNets, K = 157.",
        f"it reports the result, {rate:g}, without a figure.",
        figures.range_test(result, rate),
        provenance,
    )
