"""The command `uwb-mitigation`: assembles the sub-commands and turns errors into one clear line."""

from __future__ import annotations

import sys
from typing import Annotated, NoReturn

import typer

import uwb_mitigation
from uwb_mitigation.commands import (
    bench_nodes,
    bench_serial,
    bench_training,
    console,
    data,
    doctor,
    firmware,
    link,
    model,
    process,
    report,
    training,
)
from uwb_mitigation.errors import UwbMitigationError, not_installed

app = typer.Typer(
    name="uwb-mitigation",
    help="Remove the range error of ultra-wideband ranging: import recordings, train and evaluate models.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(data.app, name="data")
app.add_typer(model.app)
bench = typer.Typer(help="Measure what the parts of the system can do.", no_args_is_help=True)
app.add_typer(bench, name="bench")
bench.command("link")(link.bench_link)
bench.command("serial")(bench_serial.bench_serial)
bench.command("nodes")(bench_nodes.bench_nodes)
bench.command("soak")(bench_nodes.bench_soak)
bench.command("firmware")(firmware.bench_firmware)
app.command("process")(process.process)
app.command("protocol")(training.protocol)
app.command("search")(training.search)
app.command("train-lr-range")(training.train_lr_range)
app.command("prune")(training.prune)
bench.command("training")(bench_training.bench_training)
app.command("report")(report.report)
app.command("emulate-board")(link.emulate_board)
app.command("export-c")(firmware.export_c)
app.command("doctor")(doctor.doctor)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(uwb_mitigation.__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    pass


def _fail(error: UwbMitigationError) -> NoReturn:
    console.err.print(f"uwb-mitigation: {error}", style="red", markup=False, soft_wrap=True)
    sys.exit(1)


def main() -> None:
    """Run the command line; exit 1 with one line on bad input, 130 on Ctrl-C.

    Where the reader of standard output (head, less) goes away, typer and rich end it: silently, with 1.
    """
    try:
        app()
    except UwbMitigationError as error:
        _fail(error)
    except ModuleNotFoundError as error:
        from uwb_mitigation.installation import distribution_of

        distribution = distribution_of(error.name or "")
        if distribution is None:
            raise
        _fail(not_installed(distribution))
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
