"""The paper's tables, with measured numbers next to the published ones. A missing measurement is marked as such."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from benchmarks.paper import published
from benchmarks.paper.results import FORMS, ExperimentResults, FirmwareRow, Spread, TrainedModel
from uwb_mitigation.mitigation.model.architecture import Mlp, Remnet

NAMES = {
    "remnet": "REMNet",
    "remnet_k5": "REMNet, k0 = 5",
    "mlp": "MLP",
    "raw": "No correction",
    "los_median": "Median error in LOS",
    "overall_median": "Median error",
    "line": "L1 line",
    "cortex_m4": "Cortex-M4",
    "portable": "portable C",
}
"""{name in result files: human-readable name}."""

_ROWS = [*(("remnet", samples) for samples in published.WINDOWS), ("mlp", max(published.WINDOWS))]


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table.

    Attributes:
        kind: `head`, `paper`, `measured`, `estimated`, `missing` (measurable, but not measured) or `none` (no such value).
        value: the number; `std` over `n` seeds.
    """

    text: str
    kind: str
    value: float | None = None
    std: float | None = None
    n: int | None = None


NONE, MISSING = Cell("–", "none"), Cell("not measured", "missing")


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of the measured numbers of a table or a figure."""

    data: str
    split: str
    seeds: str
    command: str


@dataclass(frozen=True, slots=True)
class ReportTable:
    """One table.

    Attributes:
        note: how to read it.
        groups: (text, number of columns) above the column heads, without the columns that name a row.
        columns: heads of all columns; the first `heads` name a row.
        rows: one cell per column.
        missing: command that measures missing values.
    """

    id: str
    title: str
    note: str
    groups: tuple[tuple[str, int], ...]
    columns: tuple[str, ...]
    heads: int
    rows: tuple[tuple[Cell, ...], ...]
    provenance: Provenance
    missing: str = ""

    @property
    def has_gaps(self) -> bool:
        """Whether a measurable value is missing."""
        return any(cell.kind == "missing" for row in self.rows for cell in row)


def number_cell(value: float | None, form: str, kind: str, otherwise: Cell = NONE) -> Cell:
    """Return a formatted number, or `otherwise` without a value."""
    return otherwise if value is None else Cell(form.format(value), kind, value)


def number_cells(values: Iterable[float | None], form: str, kind: str) -> list[Cell]:
    """Return `number_cell` of each value."""
    return [number_cell(value, form, kind) for value in values]


def accuracy(
    trainings: ExperimentResults, provenance: Provenance, missing: str, measured: str
) -> ReportTable:
    """Return Table 1, MAE before and after graph optimisation and quantisation; `measured` heads our columns."""
    rows = []
    for heads, parameters, models, published_row in _networks(trainings):
        paper = [NONE] * 4
        if published_row:
            paper = [
                number_cell(published_row.parameters, "{:.0f}", "paper"),
                *number_cells(published_row.mae_m, "{:.4f}", "paper"),
            ]
        rows.append((*heads, *paper, parameters, *_forms(models, "mae", 1.0, 4)))
    baselines_by_name = {baseline.name: baseline for baseline in trainings.baselines}
    mae_by_name = {
        name: baseline.errors.all.mae if baseline.errors else None
        for name, baseline in baselines_by_name.items()
    }
    mae_by_name["raw"] = trainings.models[0].mae_raw if trainings.models else None
    for name in dict.fromkeys(["raw", "los_median", "overall_median", "line", *baselines_by_name]):
        cell = number_cell(mae_by_name[name], "{:.4f}", "measured") if name in mae_by_name else MISSING
        head = Cell(NAMES.get(name, name), "head"), Cell("–", "head")
        rows.append((*head, *[NONE] * 5, cell, NONE, NONE))
    reasons = [
        f" {NAMES.get(name, name)}: {baseline.reason}."
        for name, baseline in baselines_by_name.items()
        if baseline.reason
    ]
    return ReportTable(
        "table1",
        "Table 1. Accuracy for each length of the CIR, before and after optimisation",
        "MAE on the test part, m; mean ± standard deviation over seeds. Optimised: ONNX Runtime's graph. "
        "Below the networks: baselines that were fitted on the same training part (constants, and a line in received "
        "and first-path power)." + "".join(reasons),
        (("Paper", 4), (measured, 4)),
        ("Model", "CIR", *(["Params", *(f"MAE {form}" for form in FORMS)] * 2)),
        2,
        tuple(rows),
        provenance,
        missing,
    )


def sizes(trainings: ExperimentResults, provenance: Provenance, missing: str) -> ReportTable:
    """Return Table 2, file sizes."""
    rows = []
    for heads, parameters, models, published_row in _networks(trainings):
        paper = number_cells(published_row.size_kb if published_row else [None] * 3, "{:.3f}", "paper")
        rows.append((*heads, parameters, *paper, *_forms(models, "bytes", 1000.0, 3)))
    return ReportTable(
        "table2",
        "Table 2. Size for each length of the CIR, before and after optimisation",
        "Files on disk, kB of 1000 bytes. Paper: TensorFlow Lite. Measured: ONNX with the model's card.",
        (("", 1), ("Paper", 3), ("Measured", 3)),
        ("Model", "CIR", "Params", *([f"{form}, kB" for form in FORMS] * 2)),
        2,
        tuple(rows),
        provenance,
        missing,
    )


def firmware(bench: Sequence[FirmwareRow], provenance: Provenance, missing: str) -> ReportTable:
    """Return Table 3, rate and energy on the microcontroller."""
    rows_by_key = {(row.network, row.samples, row.first_kernel, row.kernels): row for row in bench}
    paper_keys = [
        (network, samples, 3 if network == "remnet" else 0, "cortex_m4") for network, samples in _ROWS
    ]
    rows = []
    for key in dict.fromkeys([*paper_keys, *rows_by_key]):
        network, samples, first_kernel, kernels = key
        published_row, row = published.MODELS.get((network, samples)), rows_by_key.get(key)
        name = NAMES.get(network, network) + (f", k0 = {first_kernel}" if first_kernel not in (0, 3) else "")
        paper = [NONE] * 5
        if published_row:
            paper = [
                *number_cells(published_row.board[:4], "{:.1f}", "paper"),
                number_cell(published_row.board[4], "{:g}", "paper"),
            ]
        measured_cells = [MISSING, MISSING if published_row else NONE, *[MISSING] * 4]
        if row is not None:
            measured_cells = [
                number_cell(row.rate_hz, "≈ {:.1f}", "estimated"),
                number_cell(row.energy_mj, "≈ {:.3f}", "estimated"),
                number_cell(row.instructions, "{:,.0f}", "measured"),
                *number_cells((row.ram_bytes / 1000, row.flash_bytes / 1000), "{:.1f}", "measured"),
                Cell(f"{row.mismatches} of {row.inputs:,}", "measured", row.mismatches, n=row.inputs),
            ]
        heads = [Cell(text, "head") for text in (name, str(samples), NAMES.get(kernels, kernels))]
        rows.append((*heads, *paper, *measured_cells))
    return ReportTable(
        "table3",
        "Table 3. Real-time performance on the microcontroller",
        "Paper: measured on an Arduino Nano 33 BLE Sense. Here: instructions, memory and equality with ONNX Runtime "
        "are counted in an emulator; rate (64 MHz, no wait states) and energy (at the paper's power) are estimated. "
        "Current and power require a board.",
        (("Paper", 5), ("Estimated", 2), ("Counted in the emulator", 4)),
        (
            *("Model", "CIR", "Kernels", "f, Hz", "Vcc, V", "I, mA", "P, mW", "E, mJ"),
            *("f, Hz (est.)", "E, mJ (est.)", "Instructions", "RAM, kB", "Flash, kB", "Unequal outputs"),
        ),
        3,
        tuple(rows),
        provenance,
        missing,
    )


_Row = tuple[list[Cell], Cell, tuple[TrainedModel, ...], "published.PaperModel | None"]


def _networks(trainings: ExperimentResults) -> list[_Row]:
    """Return heads, parameters, models and published values of the paper's networks and of all other trained ones."""
    rows = []
    for network, samples in dict.fromkeys(
        [*_ROWS, *((model.network, model.samples) for model in trainings.models)]
    ):
        models = trainings.of(network, samples)
        heads = [Cell(NAMES.get(network, network), "head"), Cell(str(samples), "head")]
        # Counting parameters needs no training.
        shape = Mlp if network == "mlp" else Remnet
        count = models[0].parameters if models else shape(samples).parameters
        published_row = published.MODELS.get((network, samples))
        rows.append((heads, number_cell(count, "{}", "measured"), models, published_row))
    return rows


def _forms(models: Sequence[TrainedModel], kind: str, unit: float, digits: int) -> list[Cell]:
    """Return mean and standard deviation over seeds of each form."""
    cells = []
    for values in zip(*(model.by_form(kind) for model in models), strict=True):
        spread = Spread.of([None if value is None else value / unit for value in values])
        if spread is None:
            cells.append(NONE)
            continue
        text = f"{spread.mean:.{digits}f}"
        if spread.std and float(rounded_std := f"{spread.std:.{digits}f}"):
            text += f" ± {rounded_std}"
        cells.append(Cell(text, "measured", spread.mean, spread.std, spread.n))
    return cells or [MISSING] * len(FORMS)
