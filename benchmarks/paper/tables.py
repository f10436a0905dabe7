"""The paper's tables, with measured numbers next to the published ones. A missing measurement is marked as such."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.paper import published
from benchmarks.paper.results import FORMS, TRIAL_EPOCHS, ExperimentResults, FirmwareRow, Spread, TrainedModel

NAMES = {
    "remnet": "REMNet",
    "remnet_k5": "REMNet, k0 = 5",
    "remnet_attention": "REMNet with self-attention",
    "remnet_pruned_25": "REMNet, 25 % of weights pruned",
    "remnet_pruned_50": "REMNet, 50 % of weights pruned",
    "remnet_pruned_75": "REMNet, 75 % of weights pruned",
    "mlp": "MLP",
    "cortex_m4": "Cortex-M4",
    "portable": "portable C",
}
"""{name in result files: human-readable name}."""

_LONGEST, _SHORT = max(published.WINDOWS), 16
_ROWS = [
    *(("remnet", samples) for samples in published.WINDOWS),
    *(("remnet_k5", samples) for network, samples in published.MODELS if network == "remnet"),
    *((network, _LONGEST) for network in ("remnet_attention", "mlp")),
]


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
        rows.append((*heads, *paper, parameters, *_means([model.maes() for model in models], FORMS, 4)))
    raw = trainings.models[0].final_errors.all.mae_raw if trainings.models else None
    median = trainings.median.all.mae if trainings.median else None
    for name, mae in (("No correction", raw), ("Median error of the training part", median)):
        cells = [*[NONE] * 5, number_cell(mae, "{:.4f}", "measured", MISSING), NONE, NONE]
        rows.append((Cell(name, "head"), Cell("–", "head"), *cells))
    return ReportTable(
        "table1",
        "Table 1. Accuracy for each length of the CIR, before and after optimisation",
        "MAE on the test part, m; mean ± standard deviation over seeds. Optimised: ONNX Runtime's graph. k0: the paper's text says 5, "
        "its parameter counts require 3. Self-attention: squeeze and excitation of each residual, an assumption; int8 has no such "
        "operation here. MLP: layers of 240, 64 and 16, an assumption with the paper's number of parameters. Pruned: the smallest "
        "weights, then two passes of training.",
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
        kilobytes = [
            [model.bytes[form] / 1000 if form in model.bytes else None for form in (*FORMS, "zipped")]
            for model in models
        ]
        rows.append((*heads, parameters, *paper, *_means(kilobytes, (*FORMS, "zipped"), 3)))
    return ReportTable(
        "table2",
        "Table 2. Size for each length of the CIR, before and after optimisation",
        "Files on disk, kB of 1000 bytes. Paper: TensorFlow Lite. Measured: ONNX with the model's card. Zeros of pruned weights only "
        "save space in a compressed file (last column).",
        (("", 1), ("Paper", 3), ("Measured", 4)),
        ("Model", "CIR", "Params", *([f"{form}, kB" for form in FORMS] * 2), "int8, zipped, kB"),
        2,
        tuple(rows),
        provenance,
        missing,
    )


def firmware(bench: Sequence[FirmwareRow], provenance: Provenance, missing: str) -> ReportTable:
    """Return Table 3, rate and energy on the microcontroller."""
    rows_by_key = {(row.network, row.samples, row.first_kernel, row.kernels): row for row in bench}
    paper_keys = [("remnet", samples, 3, "cortex_m4") for samples in published.WINDOWS]
    paper_keys.append(("mlp", _LONGEST, 0, "cortex_m4"))
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
        count = models[0].parameters if models else None
        published_row = published.MODELS.get((network.removesuffix("_k5"), samples))
        rows.append((heads, number_cell(count, "{}", "measured", MISSING), models, published_row))
    return rows


def _means(values_of: Sequence[Sequence[float | None]], columns: Sequence[str], digits: int) -> list[Cell]:
    """Return mean and standard deviation over seeds of each column; `values_of` has one row per seed."""
    cells = []
    for values in zip(*values_of, strict=True):
        spread = Spread.of(list(values))
        if spread is None:
            cells.append(NONE)
            continue
        text = f"{spread.mean:.{digits}f}"
        if spread.std and float(rounded_std := f"{spread.std:.{digits}f}"):
            text += f" ± {rounded_std}"
        cells.append(Cell(text, "measured", spread.mean, spread.std, spread.n))
    return cells or [MISSING] * len(columns)


def search(trainings: ExperimentResults, provenance: Provenance, measured: str) -> ReportTable:
    """Return the Pareto front of the search and the paper's choice, which is the first trial."""
    rows, first = [], trainings.trials[0]
    # A network that was drawn again is the same one.
    networks = {tuple(trial.shape.items()): trial for trial in reversed(trainings.trials)}.values()
    for trial in networks:
        if trial.is_on_front or trial is first:
            name = "paper's choice" if trial is first else trial.stage
            sizes = *trial.shape.values(), trial.parameters, trial.multiply_accumulates
            rows.append(
                (
                    Cell(name + (", front" if trial.is_on_front else ""), "head"),
                    *number_cells(sizes, "{:,}", "measured"),
                    Cell(f"{trial.mae:.4f}", "measured", trial.mae),
                )
            )
    return ReportTable(
        "search",
        "Search for hyper-parameters",
        f"{len(networks)} networks: random search, then a grid around the best one, {TRIAL_EPOCHS} epochs each; "
        "MAE on a fifth of the training placements. Front: no other network has both a smaller MAE and fewer operations. The paper "
        "reports its choice (N = 3, k0 = 5, kn = 3, F = 16), but neither searched values nor errors.",
        (("Network", 4), (measured, 3)),
        ("Found by", "N", "k0", "kn", "F", "Params", "Multiply-accumulates", "MAE, m"),
        1,
        tuple(sorted(rows, key=lambda row: row[6].value or 0)),
        provenance,
    )


def statements(trainings: ExperimentResults) -> dict[str, str]:
    """Return the measured values of numbers in the paper's text; empty without REMNet and MLP of the longest window."""
    remnet, mlp = (trainings.of(network, _LONGEST) for network in ("remnet", "mlp"))
    if not (remnet and mlp):
        return {}
    raw = remnet[0].errors["float"].all
    floating, optimised, int8 = (
        float(np.mean([model.errors[form].all.mae for model in remnet])) for form in FORMS
    )
    baseline = float(np.mean([model.errors["float"].all.mae for model in mlp]))
    short = trainings.of("remnet", _SHORT)

    def change(value: float, reference: float | None, digits: int = 1) -> str:
        return f"{100 * (value / (reference or 1.0) - 1):+.{digits}f} %"

    def smaller(form: str, reference: str) -> str:
        return " / ".join(
            change(models[0].bytes[form], models[0].bytes[reference], 0) for models in (remnet, mlp)
        )

    return {
        "raw": f"{raw.mae_raw:.4f}, {raw.sigma_raw:.4f}",
        "reduction": change(floating, raw.mae_raw),
        "mlp": change(baseline, floating),
        "parameters": f"{100 * remnet[0].parameters / mlp[0].parameters:.1f} %",
        "optimised": f"{optimised - floating:+.4f}",
        "int8": f"{int8 - floating:+.4f}",
        "optimised_size": smaller("optimised", "float"),
        "int8_size": smaller("int8", "optimised"),
        "minutes": f"{remnet[0].seconds / 60:.1f} min of one CPU core; {len(remnet)} trained together, time divided by {len(remnet)}",
        "mlp_size": f"{mlp[0].bytes['int8'] / remnet[0].bytes['int8']:.1f} times",
        **(
            {"shorter": change(float(np.mean([model.errors["int8"].all.mae for model in short])), int8)}
            if short
            else {}
        ),
        **(
            {"rate": f"{test.falls_from:.1g} to {test.falls_to:.1g}"}
            if (test := trainings.range_test)
            else {}
        ),
    }
