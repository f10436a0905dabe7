"""The tables of the paper with measured numbers beside its own. No numbers are made here: what was not measured
says so, and names the command that would measure it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from uwb_mitigation.evaluation import paper
from uwb_mitigation.evaluation.results import FORMS, ExperimentResults, FirmwareRow, Spread, TrainedModel
from uwb_mitigation.model.architecture import Mlp, Remnet

NOT_MEASURED = "not measured"

_NAMES = {
    "remnet": "REMNet",
    "remnet_k5": "REMNet, k0 = 5",
    "remnet_attention": "REMNet with attention",
    "mlp": "MLP",
}
_BASELINES = {
    "raw": "No correction",
    "los_median": "Median error in LOS",
    "overall_median": "Median error",
    "line": "L1 line",
}
_ROWS = [*(("remnet", samples) for samples in paper.WINDOWS), ("mlp", max(paper.WINDOWS))]
_FORM_NAMES = ("float", "optimised", "int8")


@dataclass(frozen=True, slots=True)
class Cell:
    """Attributes:
    text: as shown.
    kind: `head`, `paper`, `measured`, `estimated`, `missing` (could be measured) or `none` (there is no such thing).
    value: the number itself; `std` over `n` seeds.
    """

    text: str
    kind: str
    value: float | None = None
    std: float | None = None
    n: int | None = None


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a table's or a figure's own numbers come from."""

    data: str
    split: str
    seeds: str
    command: str


@dataclass(frozen=True, slots=True)
class Table:
    """Attributes:
    id, title, note: what it is, and how to read it.
    groups: (text, columns under it), over all columns but those of the row's head.
    columns: heads of all columns, the first `heads` of which name a row.
    rows: cells, one for each column.
    provenance: of the measured columns.
    missing: how to measure what is not; empty if all is.
    """

    id: str
    title: str
    note: str
    groups: tuple[tuple[str, int], ...]
    columns: tuple[str, ...]
    heads: int
    rows: tuple[tuple[Cell, ...], ...]
    provenance: Provenance
    missing: str

    @property
    def has_gaps(self) -> bool:
        """Whether something in it could be measured and was not."""
        return any(cell.kind == "missing" for row in self.rows for cell in row)

    def as_json(self) -> dict[str, object]:
        """For a program to read."""
        return {**asdict(self), "has_gaps": self.has_gaps}


def network_name(network: str) -> str:
    """A network's name for people."""
    return _NAMES.get(network, network)


def number(value: float | None, form: str, kind: str) -> Cell:
    """A number, shown by `form`, or a dash where there is none."""
    return Cell("–", "none") if value is None else Cell(form.format(value), kind, value)


def accuracy(
    trainings: ExperimentResults, provenance: Provenance, missing: str, measured: str = "Measured"
) -> Table:
    """Table 1: MAE before and after graph optimisation and quantisation; `measured` heads our own columns."""
    rows = []
    for network, samples in _networks(trainings):
        models = trainings.of(network, samples)
        printed = paper.MODELS.get((network, samples))
        rows.append(
            (
                *_heads(network, samples),
                number(printed.parameters if printed else None, "{:.0f}", "paper"),
                *(
                    number(printed.mae_m[form] if printed else None, "{:.4f}", "paper")
                    for form in range(len(FORMS))
                ),
                _parameters(network, samples, models),
                *(_seeds(models, [m.mae_m[form] for m in models], 1, 4) for form in range(len(FORMS))),
            )
        )
    known = {baseline.name: baseline for baseline in trainings.baselines}
    names = dict.fromkeys([*_BASELINES, *known])
    left = {name: None if b.errors is None else b.errors.all.mae for name, b in known.items()}
    left["raw"] = trainings.mae_raw
    rows += [_baseline_row(_BASELINES.get(name, name), name in left, left.get(name)) for name in names]
    reasons = [f" {_BASELINES.get(name, name)}: {b.reason}." for name, b in known.items() if b.reason]
    return Table(
        "table1",
        "Table 1. Accuracy for each length of the CIR, before and after optimisation",
        "MAE on the test part, m; mean ± standard deviation over seeds. Optimised: ONNX Runtime's graph. "
        "Below the networks, what needs none, fitted on the same training part: constants, "
        "and a line in received and first-path power." + "".join(reasons),
        (("Paper", 4), (measured, 4)),
        ("Model", "CIR", *(["Params", *(f"MAE {form}" for form in _FORM_NAMES)] * 2)),
        2,
        tuple(rows),
        provenance,
        missing,
    )


def _baseline_row(name: str, measured: bool, mae_m: float | None) -> tuple[Cell, ...]:
    """A row of Table 1: neither CIR nor parameters, and one form alone."""
    none = Cell("–", "none")
    left = number(mae_m, "{:.4f}", "measured") if measured else Cell(NOT_MEASURED, "missing")
    return (Cell(name, "head"), Cell("–", "head"), none, none, none, none, none, left, none, none)


def sizes(trainings: ExperimentResults, provenance: Provenance, missing: str) -> Table:
    """Table 2: sizes of the files."""
    rows = []
    for network, samples in _networks(trainings):
        models = trainings.of(network, samples)
        printed = paper.MODELS.get((network, samples))
        rows.append(
            (
                *_heads(network, samples),
                _parameters(network, samples, models),
                *(
                    number(printed.size_kb[form] if printed else None, "{:.3f}", "paper")
                    for form in range(len(FORMS))
                ),
                *(
                    _seeds(models, [m.size_bytes[form] for m in models], 1000, 3)
                    for form in range(len(FORMS))
                ),
            )
        )
    return Table(
        "table2",
        "Table 2. Size for each length of the CIR, before and after optimisation",
        "Files on disk, kB of 1000 bytes; the paper's are TensorFlow Lite's, those measured are ONNX "
        "with the model's card.",
        (("", 1), ("Paper", 3), ("Measured", 3)),
        ("Model", "CIR", "Params", *([f"{form}, kB" for form in _FORM_NAMES] * 2)),
        2,
        tuple(rows),
        provenance,
        missing,
    )


def firmware(bench: Sequence[FirmwareRow], provenance: Provenance, missing: str) -> Table:
    """Table 3: rate and energy on the microcontroller."""
    wanted = [(network, samples, 3 if network == "remnet" else 0, "cortex_m4") for network, samples in _ROWS]
    found = {(row.network, row.samples, row.first_kernel, row.kernels): row for row in bench}
    rows = []
    for key in [*wanted, *(key for key in found if key not in wanted)]:
        network, samples, first_kernel, kernels = key
        printed = paper.MODELS.get((network, samples))
        row = found.get(key)
        name = network_name(network) + (f", k0 = {first_kernel}" if first_kernel not in (0, 3) else "")
        rows.append(
            (
                Cell(name, "head"),
                Cell(str(samples), "head"),
                Cell({"cortex_m4": "Cortex-M4", "portable": "portable C"}.get(kernels, kernels), "head"),
                number(printed.rate_hz if printed else None, "{:.1f}", "paper"),
                number(printed.supply_v if printed else None, "{:.1f}", "paper"),
                number(printed.current_ma if printed else None, "{:.1f}", "paper"),
                number(printed.power_mw if printed else None, "{:.1f}", "paper"),
                number(printed.energy_mj if printed else None, "{:g}", "paper"),
                *_firmware_cells(row, printed is not None),
            )
        )
    return Table(
        "table3",
        "Table 3. Real-time performance on the microcontroller",
        "Paper: measured on an Arduino Nano 33 BLE Sense. Here: instructions, memory and equality with ONNX Runtime "
        "are counted in an emulator; rate (64 MHz, no wait states) and energy (at the paper's power) are estimated. "
        "Current and power take a board to measure.",
        (("Paper", 5), ("Estimated", 2), ("Counted in the emulator", 4)),
        (
            "Model",
            "CIR",
            "Kernels",
            "f, Hz",
            "Vcc, V",
            "I, mA",
            "P, mW",
            "E, mJ",
            "f, Hz (est.)",
            "E, mJ (est.)",
            "Instructions",
            "RAM, kB",
            "Flash, kB",
            "Unequal outputs",
        ),
        3,
        tuple(rows),
        provenance,
        missing,
    )


def _firmware_cells(row: FirmwareRow | None, has_power: bool) -> list[Cell]:
    if row is None:
        energy = Cell(NOT_MEASURED, "missing") if has_power else Cell("–", "none")
        return [Cell(NOT_MEASURED, "missing"), energy, *[Cell(NOT_MEASURED, "missing")] * 4]
    return [
        Cell(f"≈ {row.rate_hz:.1f}", "estimated", row.rate_hz),
        Cell("–", "none")
        if row.energy_mj is None
        else Cell(f"≈ {row.energy_mj:.3f}", "estimated", row.energy_mj),
        Cell(f"{row.instructions:,.0f}", "measured", row.instructions),
        Cell(f"{row.ram_bytes / 1000:.1f}", "measured", row.ram_bytes / 1000),
        Cell(f"{row.flash_bytes / 1000:.1f}", "measured", row.flash_bytes / 1000),
        Cell(f"{row.mismatches} of {row.inputs:,}", "measured", row.mismatches, n=row.inputs),
    ]


def _networks(trainings: ExperimentResults) -> list[tuple[str, int]]:
    """The paper's networks, and what else was trained."""
    return list(dict.fromkeys([*_ROWS, *((model.network, model.samples) for model in trainings.models)]))


def _heads(network: str, samples: int) -> tuple[Cell, Cell]:
    return Cell(network_name(network), "head"), Cell(str(samples), "head")


def _parameters(network: str, samples: int, models: Sequence[TrainedModel]) -> Cell:
    """Of the trained network, else of its architecture: a count needs no training."""
    shape = Mlp if network == "mlp" else Remnet
    count = models[0].parameters if models else shape(samples).parameters
    return Cell(str(count), "measured", count)


def _seeds(models: Sequence[TrainedModel], values: list[float | None], unit: float, digits: int) -> Cell:
    spread = Spread.of([None if value is None else value / unit for value in values])
    if spread is None:
        return Cell("–", "none") if models else Cell(NOT_MEASURED, "missing")
    text = f"{spread.mean:.{digits}f}"
    if spread.std and float(around := f"{spread.std:.{digits}f}"):
        text += f" ± {around}"
    return Cell(text, "measured", spread.mean, spread.std, spread.n)
