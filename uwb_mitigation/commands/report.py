"""`uwb-mitigation report`: the paper's tables and figures for one recording, beside the paper's own."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import needs_torch
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.files import write_whole

PAGE = "report.html"


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
        Path | None, typer.Option(metavar="DIR", help="Folder of `protocol`, for Tables 1, 2 and Fig. 5.")
    ] = None,
    firmware: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON of `bench firmware`, for Table 3.")
    ] = None,
    train: Annotated[
        Training | None,
        typer.Option(help="Train the networks now: 2 epochs, one seed. To try out, not to cite."),
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="The data is simulated, though its file does not say so.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """One HTML page: the paper's tables and figures beside yours.

    The paper's own figures stand beside what is measured here.
    """
    if models is not None and train is not None:
        raise ParameterError("both --models and --train", valid="one of them")
    # Before the work, not after: a missing library, a wrong file, a place that cannot be written to.
    from uwb_mitigation.evaluation import material
    from uwb_mitigation.evaluation import report as reports
    from uwb_mitigation.evaluation.results import parse_firmware, read, read_experiment
    from uwb_mitigation.preprocessing import Scaling

    trainings = None if models is None else read_experiment(models)
    bench = () if firmware is None else parse_firmware(read(firmware), str(firmware))
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be made: {error.strerror}", where=str(output)) from error
    with console.reading() as on_record:
        study = material.read_study(data, simulated, on_record)
    folder = models
    if train is Training.QUICK:
        with needs_torch():
            from uwb_mitigation.training.experiment import run_quick

        folder = output / "models"
        with console.share_bar("training, quick") as update:
            trainings = run_quick(study.title, study.dataset, folder, update)
    commands = reports.Commands(
        str(data),
        str(output),
        None if models is None else str(models),
        None if firmware is None else str(firmware),
        train is not None,
        simulated,
        study.dataset.preprocessing.scaling is Scaling.PREAMBLE,
    )
    left_m = {}
    if trainings is not None and folder is not None:

        def show(error: UwbMitigationError) -> None:
            console.err.print(f"left out of Fig. 5: {error}", markup=False, soft_wrap=True)

        left_m = material.errors_left(study, trainings, folder, show)
    with console.step_bar("drawing", reports.STEPS) as on_step:
        result = reports.build(study, commands, trainings, left_m, bench, on_step)
    page = output / PAGE
    write_whole(page, result.html())
    console.write_json(json, result.as_json())
    gaps = [table.title.split(".")[0] for table in result.tables if table.has_gaps]
    console.out.print(
        f"{page}: {len(result.tables)} tables, {len(result.pictures)} figures, {len(study.dataset)} measurements"
        + (f"; not all measured: {', '.join(gaps)} (the page says how)" if gaps else ""),
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if result.lacking:
        text = f"Without {result.lacking}. To have all of it: {result.to_fill}"
        console.out.print(text, markup=False, highlight=False, soft_wrap=True)
