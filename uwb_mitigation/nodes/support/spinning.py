"""Start, spin and shut down the nodes of this package."""

from __future__ import annotations

import gc
import importlib
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from uwb_mitigation.errors import ParameterError, UwbMitigationError, missing_dependency
from uwb_mitigation.nodes.support.parameter_tables import CRASHED, REFUSED

NodeT = TypeVar("NodeT", bound=Node)

SPIN_S = 0.2

NAME_ERRORS = ("invalid node name", "length should not exceed")
"""Parts of rcl's errors for names and namespaces."""

_stop = threading.Event()


def stop_event() -> threading.Event:
    """Return the event that SIGINT and SIGTERM set from now on; a second signal terminates the process immediately."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not _on_signal:
            signal.signal(number, _on_signal)
    return _stop


def _on_signal(number: int, frame: Any) -> None:
    _stop.set()
    signal.signal(number, signal.SIG_DFL)


def spin(nodes: Node | Sequence[Node], stop: threading.Event) -> None:
    """Run the callbacks of one or several nodes until `stop` is set."""
    all_nodes = nodes if isinstance(nodes, Sequence) else [nodes]
    executor = make_executor(all_nodes[0].context if all_nodes else None)
    for node in all_nodes:
        executor.add_node(node)
    # A full collection walks all imported objects and would delay a range by tens of milliseconds.
    gc.collect()
    gc.freeze()
    while not stop.is_set():
        executor.spin_once(timeout_sec=SPIN_S)


@contextmanager
def spinning_node(make_node: Callable[[Context], NodeT]) -> Iterator[NodeT]:
    """Yield a node in its own ROS context, spun by a thread until the block ends."""
    context = Context()
    _initialise(None, context)
    node = make_node(context)
    stop = threading.Event()
    thread = threading.Thread(target=spin, args=(node, stop), name="probe", daemon=True)
    thread.start()
    try:
        yield node
    finally:
        stop.set()
        thread.join()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def make_executor(context: Context | None = None) -> Executor:
    """Return the events executor (a quarter of the default's CPU time per message), or the default in older rclpy.

    Its `spin()` does not return at shutdown: call `spin_once`.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def load_node(name: str) -> Callable[[threading.Event], Iterator[Node]]:
    """Import an executable and return the function that makes its nodes, one after the other.

    The function gets the event that ends the process. `pipeline` is driver and mitigator in one process, and a locator
    if `anchors` is given: measurements go to the mitigator in memory, and `/uwb/range_raw` is published only while it
    has subscribers. Names, topics, parameters and diagnostics are the same as of separate nodes.
    """
    names = ("mitigator", "driver", "locator") if name == "pipeline" else (name,)
    classes = {
        node: getattr(importlib.import_module(f"uwb_mitigation.nodes.{node}"), node.capitalize())
        for node in names
    }

    def make_nodes(stop: threading.Event) -> Iterator[Node]:
        if name == "pipeline":
            mitigator = classes["mitigator"](subscribe=False)
            yield mitigator
            yield classes["driver"](stop, mitigator)
            # Parameters on the command line reach all nodes.
            if mitigator.given_parameters.get("anchors"):
                yield classes["locator"]()
        else:
            # The end of a replay ends the process.
            yield classes[name](stop) if name == "driver" else classes[name]()

    return make_nodes


def run_node(name: str) -> None:
    """Run an executable until a signal or until one of its nodes ends it; exit with its code."""
    try:
        code = _run(name)
    except Exception:
        traceback.print_exc()
        code = CRASHED
    sys.exit(code)


def correctable_error(error: Exception) -> UwbMitigationError | None:
    """Return an error that a user can correct, also for a missing library and an invalid name; None for other errors."""
    if isinstance(error, UwbMitigationError):
        return error
    if isinstance(error, ImportError):
        return missing_dependency(error)
    # rcl reports names that are too long only in its text.
    text = str(error).partition(", at /")[0]
    is_name = isinstance(error, RuntimeError) and any(words in text for words in NAME_ERRORS)
    if is_name or isinstance(error, NameValidationException):
        return ParameterError(text, valid="the rules of ROS for names")
    return None


def _run(name: str) -> int:
    """Initialise ROS, make the nodes, spin them, and destroy them in reverse order; return the exit code.

    SIGINT and SIGTERM set the event that the nodes get. ROS's own handlers would shut the context down while
    callbacks still publish.
    """
    nodes: list[Node] = []
    code_of_errors = REFUSED
    try:
        _initialise(words := list(sys.argv))
        if unknown := remove_ros_args(words)[1:]:
            raise ParameterError(
                f"arguments {' '.join(unknown)!r}", valid="parameters follow --ros-args, as in -p name:=value"
            )
        # Load before the handlers are installed: until then a signal terminates the process immediately.
        make_nodes = load_node(name)
        stop = stop_event()
        # If one cannot be made, the list contains those before it.
        nodes.extend(make_nodes(stop))
        code_of_errors = CRASHED
        spin(nodes, stop)
    except Exception as error:
        problem = correctable_error(error)
        if problem is None:
            raise
        print(f"error: {problem}", file=sys.stderr)
        return code_of_errors
    finally:
        for node in reversed(nodes):
            node.destroy_node()
        rclpy.try_shutdown()
    return max((int(getattr(node, "exit_code", 0)) for node in nodes), default=0)


def _initialise(words: list[str] | None, context: Context | None = None) -> None:
    """Initialise ROS without its signal handlers; `words`: None: `sys.argv`.

    Raises:
        ParameterError: ROS cannot parse an argument or a variable of its environment.
    """
    try:
        rclpy.init(args=words, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # Without positions in the source files of ROS.
        first_line = str(error).strip().splitlines()[0].split(", at /")[0]
        valid = "check what follows --ros-args, and the environment: ROS_..., RMW_..."
        raise ParameterError(first_line, valid=valid) from error
