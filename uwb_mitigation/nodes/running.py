"""How a node of this package starts, spins and ends."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable, Sequence

import rclpy
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.nodes.signals import stop_event

PATIENCE_S = 0.2


def spin(nodes: Node | Sequence[Node], stop: threading.Event) -> None:
    """Serve the callbacks of one node, or of several, until `stop` is set."""
    executor = make_executor()
    for node in nodes if isinstance(nodes, Sequence) else [nodes]:
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


def run(
    make_nodes: Callable[[threading.Event], Sequence[Node]], arguments: Sequence[str] | None = None
) -> int:
    """Initialise ROS, make nodes, spin them, and end cleanly. Returns the process's exit code.

    SIGINT and SIGTERM set the event that `make_nodes` is given; so may a node, with its `exit_code`
    set before. Nodes are destroyed in their order. ROS's own handlers would tear the context down
    under callbacks that still publish.
    """
    stop = stop_event()
    nodes: Sequence[Node] = ()
    try:
        if stop.is_set():
            return 0
        _initialise(arguments)
        try:
            nodes = make_nodes(stop)
        except (rclpy_implementation.RCLError, NameValidationException) as error:
            raise ParameterError(_first_line(error), valid="check the names given to --ros-args") from error
        spin(nodes, stop)
    except UwbMitigationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((int(getattr(node, "exit_code", 0)) for node in nodes), default=0)


def _initialise(arguments: Sequence[str] | None) -> None:
    """Initialise ROS without its signal handlers.

    Raises:
        ParameterError: an argument that ROS cannot read, or that is none of ROS's.
    """
    words = list(sys.argv if arguments is None else arguments)
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
