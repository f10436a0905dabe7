"""Entry points, with signal handling during imports. Standard library only: other imports take a second.

python -m uwb_mitigation.commands.entry NODE --ros-args ...
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NODES = ("driver", "mitigator", "locator", "pipeline", "monitor", "px4", "viewer")


def __getattr__(name: str) -> Callable[[], None]:
    """Return the entry point of a node."""
    if name in _NODES:
        return partial(_node, name)
    raise AttributeError(name)


def command_line() -> None:
    """Run the command `uwb-mitigation`."""
    run_program("uwb_mitigation.commands.cli", "main")


def run_program(module: str, function: str) -> None:
    """Import a module and call a function in it, which receives Ctrl-C as KeyboardInterrupt.

    A signal during the import ends the process without a traceback, with exit code 128 + its number.
    """
    run = _load(module, function)
    sys.unraisablehook = _raise_again
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        run()
    finally:
        # If a signal interrupted exec() of a text, as in the declaration of a class, `python -m` ends with this signal
        # instead of the exit code, unless a later text was executed completely.
        exec("")


def _raise_again(unraisable: Any) -> None:
    """Raise the exception of a signal handler again, if the signal arrived in a callback (destructor, weak reference).

    Python prints such exceptions and drops them, so that Ctrl-C would have no effect, also while modules are imported.
    """
    if not issubclass(unraisable.exc_type, KeyboardInterrupt | SystemExit):
        sys.__unraisablehook__(unraisable)
        return
    error = unraisable.exc_value or unraisable.exc_type()

    def interrupt(number: int, frame: object) -> None:
        raise error

    # The callback has returned by then.
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def _node(name: str) -> None:
    if name not in _NODES:
        from uwb_mitigation.errors import did_you_mean

        sys.exit(f"error: unknown node {name!r}; {did_you_mean(name, _NODES)} (one of {', '.join(_NODES)})")
    if {"-h", "--help"} & set(sys.argv[1:]):
        from uwb_mitigation.nodes.support.parameter_tables import help_text

        # A reader such as `head` may close the pipe early.
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        print(help_text(name))
    elif name == "monitor":
        # The monitor draws in this thread and spins in another.
        _load("uwb_mitigation.nodes.monitor", "run_monitor")()
    else:
        if name == "viewer":
            # On a loaded CPU, correcting ranges has priority. Set this before the middleware starts its threads.
            os.nice(10)
        # It installs signal handlers after the node is loaded.
        _load("uwb_mitigation.nodes.support.spinning", "run_node")(name)


def _load(module: str, function: str) -> Callable[..., Any]:
    """Return a function of a module; a signal during the import exits immediately with 128 + its number.

    If a dependency is missing, the process exits with a one-line error.
    """
    for number in _SIGNALS:
        signal.signal(number, _end)
    try:
        loaded: Callable[..., Any] = getattr(importlib.import_module(module), function)
    except ImportError as error:
        from uwb_mitigation.errors import missing_dependency

        if (absent := missing_dependency(error)) is None:
            raise
        sys.exit(f"error: {absent}")
    return loaded


def _end(number: int, frame: Any) -> None:
    os._exit(128 + number)


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv[1:2]):
        print(f"usage: entry NODE [--help | --ros-args ...] (NODE: {', '.join(_NODES)})")
    elif len(sys.argv) < 2:
        sys.exit(f"error: no node is named (one of {', '.join(_NODES)})")
    else:
        _node(sys.argv.pop(1))
