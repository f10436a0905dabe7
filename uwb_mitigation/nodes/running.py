"""How a node of this package starts, spins and ends."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from uwb_mitigation.errors import UwbMitigationError

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
    set before. Nodes are destroyed in their order. ROS's own handlers would tear the context down under callbacks that still publish.
    """
    stop = threading.Event()

    def on_signal(number: int, frame: Any) -> None:
        stop.set()
        # A second one ends the process the hard way.
        signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    nodes: Sequence[Node] = ()
    try:
        nodes = make_nodes(stop)
        spin(nodes, stop)
    except UwbMitigationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((int(getattr(node, "exit_code", 0)) for node in nodes), default=0)
