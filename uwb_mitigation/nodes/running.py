"""How a node of this package starts, spins and ends."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode

from uwb_mitigation.errors import UwbMitigationError


def spin(node: LifecycleNode) -> None:
    """Serve callbacks until the context shuts down (Ctrl-C, SIGTERM, or the node itself).

    The events executor costs a quarter of the default executor's time a message; its own `spin()`
    never returns on shutdown, so it is turned here. Older rclpy releases lack it.
    """
    try:
        from rclpy.experimental import EventsExecutor as Executor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor as Executor
    executor = Executor()
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.2)


def run(make_node: Callable[[], LifecycleNode], arguments: Sequence[str] | None = None) -> int:
    """Initialise ROS, make a node, spin it, and end cleanly. Returns the process's exit code.

    A node may set `exit_code` before it shuts the context down.
    """
    rclpy.init(args=arguments)
    node: LifecycleNode | None = None
    try:
        node = make_node()
        spin(node)
    except KeyboardInterrupt:
        pass
    except UwbMitigationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return int(getattr(node, "exit_code", 0))
