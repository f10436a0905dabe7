"""How a node of this package starts, spins and ends."""

from __future__ import annotations

import gc
import importlib
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from uwb_mitigation.errors import ParameterError, UwbMitigationError, not_imported
from uwb_mitigation.nodes.signals import stop_event

PATIENCE_S = 0.2


def spin(nodes: Node | Sequence[Node], stop: threading.Event) -> None:
    """Serve the callbacks of one node, or of several, until `stop` is set."""
    all_nodes = nodes if isinstance(nodes, Sequence) else [nodes]
    executor = make_executor(all_nodes[0].context if all_nodes else None)
    for node in all_nodes:
        executor.add_node(node)
    # What was imported stays for good: a full collection would walk all of it, and delay a range by
    # tens of milliseconds.
    gc.collect()
    gc.freeze()
    while not stop.is_set():
        executor.spin_once(timeout_sec=PATIENCE_S)


def make_executor(context: Context | None = None) -> Executor:
    """The events executor, a quarter of the default executor's cost a message; older rclpy lacks it.

    Its own `spin()` never returns on shutdown: turn it by `spin_once`.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def main(module: str) -> None:
    """Be the process of a module of `nodes`, whose `make_nodes` is called once it is loaded."""
    sys.exit(_run(f"uwb_mitigation.nodes.{module}"))


def _run(module: str) -> int:
    """Initialise ROS, load a module, make its nodes, spin them, and end cleanly. Returns the process's exit code.

    SIGINT and SIGTERM set the event that `make_nodes` is given; so may a node, with its `exit_code`
    set before. Nodes are destroyed in their order. ROS's own handlers would tear the context down
    under callbacks that still publish.
    """
    nodes: Sequence[Node] = ()
    try:
        _initialise()
        try:
            with _participant():
                make_nodes = importlib.import_module(module).make_nodes
                stop = stop_event()
                nodes = make_nodes(stop)
        except (rclpy_implementation.RCLError, NameValidationException) as error:
            raise ParameterError(_first_line(error), valid="check the names given to --ros-args") from error
        spin(nodes, stop)
    except ImportError as error:
        if (absent := not_imported(error)) is None:
            raise
        print(f"error: {absent}", file=sys.stderr)
        return 1
    except UwbMitigationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((int(getattr(node, "exit_code", 0)) for node in nodes), default=0)


@contextmanager
def _participant() -> Iterator[None]:
    """Join the graph by a hidden node, until there are others: the middleware's participant is the process's.

    Finding each other takes the middleware longer than loading takes Python, and goes on meanwhile.
    """
    node = Node(
        "_loading",
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
    )
    try:
        yield
    finally:
        node.destroy_node()


def _initialise() -> None:
    """Initialise ROS without its signal handlers.

    Raises:
        ParameterError: an argument that ROS cannot read, or that is none of ROS's.
    """
    words = list(sys.argv)
    try:
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ParameterError(_first_line(error), valid="check what follows --ros-args") from error
    strangers = remove_ros_args(words)[1:]
    if strangers:
        raise ParameterError(
            f"arguments {' '.join(strangers)!r}", valid="parameters follow --ros-args, as in -p name:=value"
        )


def _first_line(error: Exception) -> str:
    """What ROS says, without the places in its own source files."""
    return str(error).strip().splitlines()[0].split(", at /")[0]
