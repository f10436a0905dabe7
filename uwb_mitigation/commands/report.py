"""`uwb-mitigation report`: the paper's tables and figures for one recording, beside the paper's own."""

from __future__ import annotations

import enum
import itertools
import json as json_module
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import needs_torch
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError, UwbMitigationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from uwb_mitigation.evaluation.results import Trainings
    from uwb_mitigation.evaluation.study import Study

PAGE = "report.html"
PROTOCOL = "protocol.json"
MAX_BYTES = 64 * 2**20
"""Of a result file; the largest of ours are far smaller."""

QUICK_EPOCHS = 2
QUICK_MEASUREMENTS = 5000


class Training(str, enum.Enum):
    """What a report trains itself."""

    QUICK = "quick"


def report(
    data: Annotated[
        Path,
        typer.Option(
            help="Recording with true ranges: a bag, a folder of DecaRanging logs, or DeepUWB's pickle."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help=f"Folder for {PAGE}; made if need be.")
    ],
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help=f"Folder with {PROTOCOL}, for Tables 1, 2 and Fig. 5.")
    ] = None,
    firmware: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON of `bench firmware`, for Table 3.")
    ] = None,
    train: Annotated[
        Training | None,
        typer.Option(
            help=f"Train the networks now: {QUICK_EPOCHS} epochs, one seed. To try out, not to cite."
        ),
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="The data is simulated, though its file does not say so.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Write one HTML page with every table and figure of the paper, the paper's own figures beside what is measured."""
    if models is not None and train is not None:
        raise ParameterError("both --models and --train", valid="one of them")
    # Before the work, not after: a missing library, a wrong file, a place that cannot be written to.
    from uwb_mitigation.evaluation import report as reports
    from uwb_mitigation.evaluation.results import parse_firmware, parse_trainings
    from uwb_mitigation.preprocessing import Scaling

    trainings = None if models is None else parse_trainings(_read(models / PROTOCOL), str(models / PROTOCOL))
    bench = () if firmware is None else parse_firmware(_read(firmware), str(firmware))
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be made: {error.strerror}", where=str(output)) from error
    study = _study(data, simulated)
    folder = models
    if train is Training.QUICK:
        folder = output / "models"
        trainings = _train_quick(study, folder)
    commands = reports.Commands(
        str(data),
        str(output),
        None if models is None else str(models),
        None if firmware is None else str(firmware),
        train is not None,
        simulated,
        study.dataset.preprocessing.scaling is Scaling.PREAMBLE,
    )
    left_m = {} if trainings is None or folder is None else _errors(study, trainings, folder)
    with console.progress() as bar:
        task = bar.add_task("drawing", total=reports.STEPS)
        result = reports.build(study, commands, trainings, left_m, bench, lambda: bar.advance(task))
    page = output / PAGE
    _write(page, result.html())
    console.write_json(json, result.as_json())
    gaps = [table.title.split(".")[0] for table in result.tables if table.has_gaps]
    console.out.print(
        f"{page}: {len(result.tables)} tables, {len(result.pictures)} figures, {len(study.dataset)} measurements"
        + (f"; not all measured: {', '.join(gaps)} (the page says how)" if gaps else ""),
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


def _study(data: Path, simulated: bool) -> Study:
    """The recording, scaled by the preamble count where its radio reports one, else by the maximum."""
    from uwb_mitigation.dataset import build_dataset
    from uwb_mitigation.evaluation.study import Study
    from uwb_mitigation.preprocessing import WINDOW_SIZES, Preprocessing, Scaling
    from uwb_mitigation.sources.opening import open_recording

    with open_recording(data) as source, console.progress() as bar:
        task = bar.add_task("reading", total=None)
        records = iter(source)
        first = list(itertools.islice(records, 1))
        knows_count = bool(first) and first[0].measurement.cir.preamble_count > 0
        scaling = Scaling.PREAMBLE if knows_count else Scaling.MAX

        dataset = build_dataset(itertools.chain(first, records), Preprocessing(max(WINDOW_SIZES), scaling))
        bar.update(task, completed=1, total=1)
        return Study.of(_name(source.name, data), source.simulated or simulated, dataset)


def _name(name: str, data: Path) -> str:
    """A source's name without the way to its folder: a page is passed on."""
    return name.replace(str(data), data.resolve().name)


def _train_quick(study: Study, folder: Path) -> Trainings:
    """Every network of the paper in short, on the paper's rooms or on a split by configuration."""
    from uwb_mitigation.evaluation.results import parse_trainings
    from uwb_mitigation.preprocessing import WINDOW_SIZES

    with needs_torch():
        from uwb_mitigation.training import protocol
    split, train, test = study.quick_split()
    # Evenly over the data, whose rows are in the order of places.
    step = -(-len(train) // QUICK_MEASUREMENTS)
    if step > 1:
        split = f"{split}; one in {step} of those to train on"
    parts = protocol.Parts(study.title, split, study.dataset.rows(train[::step]), study.dataset.rows(test))
    wanted = protocol.jobs(["remnet", "mlp"], WINDOW_SIZES, seeds=1)
    with console.progress() as bar:
        task = bar.add_task("training, quick", total=1.0)
        protocol.run(
            parts,
            folder,
            wanted,
            replace(protocol.PAPER, epochs=QUICK_EPOCHS),
            on_progress=lambda share: bar.update(task, completed=share),
        )
    return parse_trainings(_read(folder / PROTOCOL), str(folder / PROTOCOL))


def _errors(study: Study, trainings: Trainings, folder: Path) -> dict[int, NDArray[np.floating]]:
    """{K: errors that REMNet leaves on the test part}, of the bundles in `folder` whose results agree with theirs."""
    import numpy as np

    from uwb_mitigation.errors import ModelError
    from uwb_mitigation.evaluation.study import agrees
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.session import Session
    from uwb_mitigation.preprocessing import WINDOW_SIZES

    rows = study.test_rows(trainings.test, trainings.mae_raw)
    if rows is None:
        return {}
    models = [model for samples in WINDOW_SIZES for model in trainings.of("remnet", samples)]
    found: dict[int, list[NDArray[np.floating]]] = {}
    with console.progress() as bar:
        for model in bar.track(models, description="applying"):
            path = folder / f"{model.name}_{'int8' if model.is_int8 else 'float'}.onnx"
            try:
                bundle = load_bundle(path)
            except ModelError as error:
                console.err.print(f"left out of Fig. 5: {error}", markup=False, soft_wrap=True)
                continue
            inputs = study.window(rows, bundle.card.preprocessing)
            if inputs is None:
                continue
            left = study.dataset.error_m[rows] - Session(bundle).predict_batch_m(inputs)
            if agrees(model, left):
                found.setdefault(model.samples, []).append(left)
    return {samples: np.concatenate(parts) for samples, parts in found.items()}


def _read(path: Path) -> object:
    """The content of a JSON file.

    Raises:
        UwbMitigationError: it cannot be read, is too large, or is no JSON.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise UwbMitigationError(f"more than {MAX_BYTES} bytes", where=str(path), valid="a result file")
        return json_module.loads(text)
    except OSError as error:
        raise UwbMitigationError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except (ValueError, RecursionError) as error:
        raise UwbMitigationError("no JSON", where=str(path), valid="a result file of this program") from error


def _write(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(path)) from error
