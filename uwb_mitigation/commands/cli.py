"""The command `uwb-mitigation`: assembles the sub-commands and turns errors into one-line messages."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from typing import Annotated, Any, NoReturn

import typer
import typer.main
from typer.core import TyperGroup

import uwb_mitigation
from uwb_mitigation.commands import (
    board,
    calibrate,
    data,
    doctor,
    field_report,
    model,
    offset,
    positioning,
    process,
    view,
)
from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.options import Command
from uwb_mitigation.errors import ParameterError, UwbMitigationError, missing_dependency

PANELS: dict[str, dict[str, typer.Typer | Callable[..., None]]] = {
    "Recordings": {"data": data.app, "process": process.process, "view": view.view},
    "Positions": {"track": positioning.track, "survey": positioning.survey, "calibrate": calibrate.calibrate},
    "Models": {
        "train": model.train,
        "train-universal": model.train_universal,
        "quantise": model.quantise,
        "evaluate": model.evaluate,
        "offset": offset.offset,
    },
    "Boards": {"board": board.app, "field-report": field_report.field_report},
    "Installation": {"doctor": doctor.doctor},
}
"""Panel of each command in `--help` and docs/reference/commands.md. Add new commands here; the text shown is the
first line of the docstring."""


class _OrderedGroup(TyperGroup):
    """Shows commands in the order of `PANELS`; typer would list groups last."""

    def list_commands(self, ctx: object) -> list[str]:
        return [name for commands in PANELS.values() for name in commands]


app = typer.Typer(
    name="uwb-mitigation",
    cls=_OrderedGroup,
    help="Remove the range error of ultra-wideband ranging.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
for _panel, _commands in PANELS.items():
    for _name, _command in _commands.items():
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, name=_name, rich_help_panel=_panel)
        else:
            app.command(_name, cls=Command, rich_help_panel=_panel)(_command)


def _print_version(is_set: bool) -> None:
    if is_set:
        print(uwb_mitigation.__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _reflow_help(command: Any) -> None:
    """Wrap the help of a command and its sub-commands at the terminal's width; typer keeps a docstring's lines."""
    paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
    # Style tags keep the indent of an example: typer removes the common indent of all lines but the first.
    command.help = "\n\n".join(
        f"[none]{text}[/none]" if text.startswith(" ") else text.replace("\n", " ") for text in paragraphs
    )
    # The parameters include --help, which typer creates when it is first needed.
    for parameter in command.get_params(command.context_class(command)):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = " "  # otherwise typer shows flags as `<bool>`
    for subcommand in getattr(command, "commands", {}).values():
        _reflow_help(subcommand)


_UsageError: Any = typer.BadParameter.__base__
"""click's error for wrong usage, of which newer versions of typer contain a copy."""


def main() -> None:
    """Run `uwb-mitigation`."""
    run(app, "uwb-mitigation")


def run(app: typer.Typer, program: str) -> NoReturn:
    """Run a command line; exit with 2 and one line for wrong usage, 1 and one line for other errors, 130 on Ctrl-C.

    If the reader of standard output (head, less) exits, typer and rich exit with 1 and without a message.
    """

    def exit_with_error(error: object, code: int = 1) -> NoReturn:
        console.err.print(f"{program}: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(code)

    command: Any = typer.main.get_command(app)
    _reflow_help(command)
    try:
        sys.exit(command(standalone_mode=False))
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()
            sys.exit(2)
        name = error.ctx.command_path if error.ctx is not None else program
        exit_with_error(f"{error.format_message()} (see {name} --help)", 2)
    except ParameterError as error:
        exit_with_error(error, 2)
    except UwbMitigationError as error:
        exit_with_error(error)
    except ImportError as error:
        if (problem := missing_dependency(error)) is None:
            raise
        exit_with_error(problem)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)


if __name__ == "__main__":
    # As the installed command: a signal that arrives in a callback must not be lost.
    from uwb_mitigation.commands.entry import command_line

    command_line()
