"""The report: every table and figure of the paper beside what was measured.

Everything is text and numbers from memory here; the command reads the files and writes the page.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation import figures, paper, tables
from uwb_mitigation.evaluation.page import Picture, Report
from uwb_mitigation.evaluation.projection import Projection, principal_components
from uwb_mitigation.evaluation.results import ExperimentResults, FirmwareRow, Spread, clean
from uwb_mitigation.evaluation.splits import CONFIGURATIONS
from uwb_mitigation.evaluation.study import LOS, Box, Study, examples
from uwb_mitigation.evaluation.tables import Cell, Provenance, Table
from uwb_mitigation.sources.deepuwb import ROOM_ROWS, ROOMS

STEPS = 5
"""How often `build` tells of its progress."""

BENCH_INPUTS = 5000
"""Windows that `bench firmware` compares unless told otherwise."""

_NO_SEEDS = "none: nothing is drawn or trained"
_POINTS_SEED = 0
_SPLITS = {
    "paper": "paper (trained in the big and the small room, tested in the medium room)",
    "all_but_room_2": "all_but_room_2 (trained in all rooms but the medium one, tested there)",
}


@dataclass(frozen=True, slots=True)
class Commands:
    """How the user asked for this report, and how to measure what it lacks; as typed into a shell.

    Attributes:
        data, models, firmware: paths; the latter None where not given.
        quick: the networks were trained by the report, in short.
        simulated: the user said so.
        preamble: the data knows its preamble counts, which networks do better with.
    """

    data: str
    output: str
    models: str | None = None
    firmware: str | None = None
    quick: bool = False
    simulated: bool = False
    preamble: bool = False

    @property
    def report(self) -> str:
        """This report's own."""
        words = ["uwb-mitigation", "report", "--data", self.data, "-o", self.output]
        for option, value in (("--models", self.models), ("--firmware", self.firmware)):
            words += [option, value] if value else []
        words += ["--train", "quick"] if self.quick else []
        return _shell([*words, *(["--simulated"] if self.simulated else [])])

    def filled(self, *, models: bool = False, firmware: bool = False) -> str:
        """This report with the protocol's results, or the bench's, where it has none."""
        given = None if self.quick else self.models
        return replace(
            self,
            models=given or ("models" if models else None),
            firmware=self.firmware or ("firmware.json" if firmware else None),
            quick=self.quick and not models,
        ).report

    @property
    def protocol(self) -> str:
        """Trains every network of the paper."""
        return self.protocol_of(["remnet", "mlp"])

    def protocol_of(self, networks: Sequence[str], options: Sequence[str] = ()) -> str:
        """Trains these networks, with further options."""
        folder = "models" if self.quick or not self.models else self.models
        words = ["uwb-mitigation", "protocol", "--data", self.data, "-o", folder]
        words += ["--networks", ",".join(networks), *options]
        return _shell([*words, *(["--scaling", "preamble"] if self.preamble else [])])

    @property
    def bench(self) -> str:
        """Measures the firmware."""
        return self.bench_of(())

    def bench_of(self, rows: Sequence[FirmwareRow]) -> str:
        """Measures the firmware as these rows were, with the options that are not the bench's own."""
        words = ["uwb-mitigation", "bench", "firmware"]
        inputs = max((row.inputs for row in rows), default=BENCH_INPUTS)
        words += [] if inputs == BENCH_INPUTS else ["--inputs", str(inputs)]
        words += ["--no-portable"] if rows and all(row.kernels != "portable" for row in rows) else []
        return _shell([*words, "--json", self.firmware or "firmware.json"])


def build(
    study: Study,
    commands: Commands,
    trainings: ExperimentResults | None = None,
    left_m: Mapping[int, NDArray[np.floating]] | None = None,
    firmware: Sequence[FirmwareRow] = (),
    on_step: Callable[[], None] = lambda: None,
) -> Report:
    """Every table and figure that the data, the trainings and the bench allow; the others are named as lacking.

    Args:
        left_m: {K: errors that REMNet left on the test part, m, of all seeds}, for Fig. 5's boxes.
        on_step: called `STEPS` times.
    """
    shown = [_data_table(study, commands)]
    lacking = {}
    to_train = f"{commands.protocol} && {commands.filled(models=True)}"
    if trainings is None:
        lacking["Tables 1 and 2, Fig. 5"] = commands.protocol
    else:
        trained = _trained_provenance(study, trainings, commands)
        shown.append(tables.accuracy(trainings, trained, to_train, _measured(study)))
        shown.append(tables.sizes(trainings, trained, to_train))
    if firmware:
        emulated = Provenance(
            "windows drawn to press on every rounding",
            "none: no accuracy is measured here",
            "fixed, of the windows and of random weights; the cost depends on neither",
            commands.bench_of(firmware),
        )
        to_bench = f"{commands.bench} && {commands.filled(firmware=True)}"
        shown.append(tables.firmware(firmware, emulated, to_bench))
    else:
        lacking["Table 3"] = commands.bench
    on_step()
    pictures = [_samples(study, commands)]
    on_step()
    pictures += _projections(study, commands, on_step)
    if trainings is not None:
        pictures.append(_over_k(study, trainings, left_m or {}, trained, to_train))
    on_step()
    filled = commands.filled(models=trainings is None, firmware=not firmware)
    return Report(
        "Range error mitigation: the paper's tables and figures",
        study.title,
        study.simulated,
        commands.report,
        "; ".join(lacking),
        " && ".join([*lacking.values(), filled]) if lacking else "",
        _notices(study, trainings, commands),
        tuple(shown),
        tuple(pictures),
    )


def _shell(words: Sequence[str]) -> str:
    """A command to paste into a shell; what a page cannot hold of a file's name is replaced."""
    return clean(shlex.join(words), 2000)


def _trained_provenance(study: Study, trainings: ExperimentResults, commands: Commands) -> Provenance:
    seeds = sorted({model.seed for model in trainings.models})
    return Provenance(
        trainings.data,
        f"{_SPLITS.get(trainings.split, trainings.split)}; "
        f"{trainings.train:,} measurements to train on, {trainings.test:,} to test on",
        f"{', '.join(map(str, seeds)) or 'none'}; {_epochs(trainings)} each",
        commands.report if commands.quick else _trained_by(study, trainings, commands),
    )


def _epochs(trainings: ExperimentResults) -> str:
    return f"{trainings.options.epochs} epoch{'' if trainings.options.epochs == 1 else 's'}"


def _trained_by(study: Study, trainings: ExperimentResults, commands: Commands) -> str:
    """The command that trains as these were trained, with the options that are not the protocol's own."""
    networks = list(dict.fromkeys(model.network for model in trainings.models))
    seeds = len({model.seed for model in trainings.models})
    windows = sorted({model.samples for model in trainings.models}, reverse=True)
    # Only REMNet is trained at every length; the others have the longest alone.
    every = paper.WINDOWS if {"remnet", "remnet_k5"} & set(networks) else (max(paper.WINDOWS),)
    usual_split = "paper" if study.has_rooms else CONFIGURATIONS
    split = CONFIGURATIONS if trainings.split.startswith(CONFIGURATIONS) else trainings.split
    options = {
        "--split": (split if split in (*_SPLITS, CONFIGURATIONS) else usual_split, usual_split),
        "--windows": (",".join(map(str, windows)), ",".join(map(str, every))),
        "--seeds": (seeds, paper.SEEDS),
        "--epochs": (trainings.options.epochs, paper.EPOCHS),
        "--learning-rate": (trainings.options.learning_rate, paper.LEARNING_RATE),
    }
    said = [(option, str(value)) for option, (value, usual) in options.items() if value != usual]
    return commands.protocol_of(networks, [word for pair in said for word in pair])


def _notices(study: Study, trainings: ExperimentResults | None, commands: Commands) -> tuple[str, ...]:
    said = []
    if study.simulated:
        said.append(
            "The data is simulated: no radio was involved. Nothing here says how well a real site would do."
        )
    if study.has_rooms and study.simulated:
        said.append(
            "The data has DeepUWB's shape and none of its radio: "
            "the paper's figures stand beside for orientation, and are not the mark to reach."
        )
    elif study.has_rooms and not study.published:
        said.append(
            "The data has DeepUWB's shape, but not the published number of rows in each room: "
            "its figures are not comparable with the paper's."
        )
    elif not study.has_rooms:
        said.append(
            "The data is not the paper's (DeepUWB): the paper's figures stand beside for orientation, "
            "and are not the mark to reach."
        )
    if trainings is not None and trainings.options.epochs < paper.EPOCHS:
        how = "--train quick" if commands.quick else "the models given"
        said.append(
            f"The networks were trained for {_epochs(trainings)} ({how}), the paper's for {paper.EPOCHS}: "
            "their accuracy shows that everything works, not how well it can."
        )
    if trainings is not None:
        said += _quick(trainings)
    if refused := study.dataset.refused:
        reasons = ", ".join(f"{count:,} × {why}" for why, count in sorted(refused.items()))
        said.append(f"Measurements left out: {reasons}.")
    return tuple(said)


def _quick(trainings: ExperimentResults) -> list[str]:
    """That fewer networks were trained than the paper's tables have, if they were."""
    seeds = len({model.seed for model in trainings.models})
    lengths = len({model.samples for model in trainings.models} & set(paper.WINDOWS))
    if seeds >= paper.SEEDS and lengths == len(paper.WINDOWS):
        return []
    return [
        f"A quick look: {seeds} seed{'' if seeds == 1 else 's'} of {paper.SEEDS} and {lengths} of {len(paper.WINDOWS)} "
        "lengths of the CIR were trained. The other rows of Tables 1 and 2 are not measured, and no spread over seeds is "
        "told where there is but one."
    ]


def _own(study: Study, commands: Commands, seeds: str = _NO_SEEDS) -> Provenance:
    return Provenance(study.title, "none: all measurements", seeds, commands.report)


def _data_table(study: Study, commands: Commands) -> Table:
    labels = study.labels
    rows = []
    if study.has_rooms:
        for room, published in zip(ROOMS, ROOM_ROWS, strict=True):
            is_test = room == "medium room"
            printed = (paper.RAW_MAE_M, paper.RAW_SIGMA_M) if is_test else (None, None)
            rows.append(_part(study, room, study.places == room, published, *printed))
    rows += [
        _part(study, f"label {label}", labels == label)
        for label in sorted(np.unique(labels).tolist(), key=lambda name: (name != LOS, name))
    ]
    every = sum(ROOM_ROWS) if study.has_rooms else None
    rows.append(_part(study, "all", np.ones(len(labels), np.bool_), every))
    return Table(
        "data",
        "The data before any correction",
        "MAE and standard deviation of the range error, measured minus true. "
        f"{len(study.dataset.names):,} configurations "
        f"({'placements of both antennas' if study.has_placements else 'room and materials'})."
        + (" The rows of each room are those that DeepUWB publishes." if study.has_rooms else ""),
        (("Paper and DeepUWB", 3), (_measured(study), 3)),
        ("Part", *(["Measurements", "MAE, m", "σ, m"] * 2)),
        1,
        tuple(rows),
        _own(study, commands),
        "",
    )


def _measured(study: Study) -> str:
    """Heads the columns that are made of the data."""
    return "Measured on simulated data" if study.simulated else "Measured"


def _part(
    study: Study,
    name: str,
    chosen: NDArray[np.bool_],
    published: int | None = None,
    mae_m: float | None = None,
    sigma_m: float | None = None,
) -> tuple[Cell, ...]:
    """The row of a part of the data; the numbers given are the paper's and DeepUWB's own."""
    part = study.dataset.error_m[chosen]
    own = (np.abs(part).mean(), part.std()) if len(part) else (None, None)
    return (
        Cell(name, "head"),
        tables.number(published, "{:,}", "paper"),
        tables.number(mae_m, "{:.4f}", "paper"),
        tables.number(sigma_m, "{:.4f}", "paper"),
        tables.number(len(part), "{:,}", "measured"),
        *(tables.number(None if value is None else float(value), "{:.4f}", "measured") for value in own),
    )


def _samples(study: Study, commands: Commands) -> Picture:
    chosen = examples(study)
    described = "; ".join(f"{one.label}, range error {one.error_m:+.3f} m" for one in chosen)
    return Picture(
        "fig3",
        "Fig. 3. LOS and NLOS samples",
        f"Channel impulse responses over time, one panel each: {described}.",
        "Of each condition, the measurement whose range error is the median; amplitude over the window's largest. "
        "Dashed: where the radio put the first path.",
        "one LOS and one NLOS sample with normalised amplitude; in NLOS the signal arrives over many paths, "
        "and the range is biased upward.",
        figures.samples(chosen),
        {"samples": [{"label": one.label, "error_m": one.error_m} for one in chosen]},
        _own(study, commands),
    )


def _projections(study: Study, commands: Commands, on_step: Callable[[], None]) -> list[Picture]:
    projection = principal_components(study.amplitudes)
    share = " + ".join(f"{100 * part:.0f}" for part in projection.explained)
    chosen = np.arange(len(study.dataset))
    if len(chosen) > figures.MAX_POINTS:
        generator = np.random.default_rng(_POINTS_SEED)
        chosen = np.sort(generator.choice(len(chosen), figures.MAX_POINTS, replace=False))
    seeds = f"{_POINTS_SEED}, of the points drawn" if len(chosen) < len(study.dataset) else _NO_SEEDS
    place, matter = ("room", "material") if study.has_rooms else ("configuration", "label")
    pictures = []
    for letter, kind, groups in (("a", place, study.places), ("b", matter, study.materials)):
        names, counts = np.unique(groups, return_counts=True)
        many = len(names) > figures.MAX_NAMED
        pictures.append(
            Picture(
                f"fig4{letter}",
                f"Fig. 4{letter}. Principal components, by {kind}",
                f"Three-dimensional scatter of {len(chosen)} channel impulse responses along their first three "
                f"principal components, from two sides, coloured by {kind}: "
                + (f"{len(names)} of them." if many else f"{', '.join(names.tolist())}."),
                f"{len(chosen):,} of {len(study.dataset):,} windows of {study.dataset.inputs.shape[1]} amplitudes, "
                f"seen from two sides. The components carry {share} % of the variance."
                + (f" {len(names)} {kind}s, a colour each; too many to name." if many else ""),
                "the three indoor rooms lie close together, apart from outdoor and through-the-wall measurements."
                if letter == "a"
                else "materials lie in different regions; heavier ones, such as metal, are concentrated and distant "
                "from plastic and wood.",
                figures.scatter(_at(projection, chosen), groups[chosen], f"By {kind}"),
                {
                    "explained": projection.explained.tolist(),
                    "groups": dict(zip(names.tolist(), counts.tolist(), strict=True)),
                    "points": len(chosen),
                },
                _own(study, commands, seeds),
            )
        )
        on_step()
    return pictures


def _at(projection: Projection, rows: NDArray[np.intp]) -> Projection:
    return Projection(projection.points[rows], projection.explained)


def _over_k(
    study: Study,
    trainings: ExperimentResults,
    left_m: Mapping[int, NDArray[np.floating]],
    provenance: Provenance,
    missing: str,
) -> Picture:
    rows = study.test_rows(trainings.test, trainings.mae_raw)
    chosen = np.arange(len(study.dataset)) if rows is None else rows
    errors, is_los = study.dataset.error_m[chosen], study.labels[chosen] == LOS
    parts = {"all": errors, "LOS": errors[is_los], "NLOS": errors[~is_los]}
    raw = {name: Box.of(part) for name, part in parts.items() if len(part)}
    boxes = {samples: Box.of(left) for samples, left in left_m.items() if len(left)}
    spreads: dict[int, dict[str, Spread]] = {}
    for samples in paper.WINDOWS:
        models = trainings.of("remnet", samples)
        values = {
            "los": Spread.of([model.left.los.mae for model in models]),
            "nlos": Spread.of([model.left.nlos.mae for model in models]),
            "sigma": Spread.of([model.left.all.sigma for model in models]),
        }
        if models:
            spreads[samples] = {name: spread for name, spread in values.items() if spread is not None}
    gaps = [samples for samples in paper.WINDOWS if samples not in spreads or samples not in boxes]
    paper_mae = {
        samples: row.mae_m[2] for (network, samples), row in paper.MODELS.items() if network == "remnet"
    }
    described = "; ".join(
        f"K = {samples}: "
        + ", ".join(f"{name} {spread.mean:.3f} m" for name, spread in spreads[samples].items())
        if samples in spreads
        else f"K = {samples}: not measured"
        for samples in paper.WINDOWS
    )
    before = "the test part" if rows is not None else "all measurements"
    why = ""
    if any(samples in spreads and samples not in boxes for samples in paper.WINDOWS):
        why = " A box is missing where the trained files, or the measurements they were tested on, are not at hand."
    return Picture(
        "fig5",
        "Fig. 5. Errors for each length of the CIR",
        "Above, box plot of range errors before correction and after REMNet for each K; below, bars of LOS MAE, "
        f"NLOS MAE and sigma. {described}.",
        f"REMNet, int8 where it was quantised, all seeds together. Grey: {before} before correction. "
        f"Black: the paper's int8 MAE (Table 1).{why}",
        "errors grow as K falls, and K = 8 is the least that is acceptable; its LOS and NLOS MAE and its sigma "
        "are given in the picture alone, so that no numbers can be put beside.",
        figures.over_k(raw, boxes, spreads, paper_mae, paper.WINDOWS),
        {
            "raw": {name: asdict(box) for name, box in raw.items()},
            "errors": {str(samples): asdict(box) for samples, box in boxes.items()},
            "left": {
                str(samples): {name: asdict(spread) for name, spread in spread_of.items()}
                for samples, spread_of in spreads.items()
            },
            "paper_mae": {str(samples): mae for samples, mae in paper_mae.items()},
        },
        replace(provenance, data=f"{study.title} before correction; networks: {provenance.data}"),
        missing if gaps else "",
    )
