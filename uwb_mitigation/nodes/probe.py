"""A node that looks at others from outside: what benchmarks and demos subscribe and ask with."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes.spinning import spin

AnyNode = TypeVar("AnyNode", bound=Node)

_PATIENCE_S = 30.0
_DEPTH = 50_000


@contextmanager
def watching(make_node: Callable[[Context], AnyNode]) -> Iterator[AnyNode]:
    """A node in a ROS context of its own, spun by a thread until the block ends."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
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


class Probe(Node):
    """Subscribes with a queue that holds whatever comes, and sets parameters of other nodes."""

    def __init__(self, context: Context) -> None:
        super().__init__("probe", context=context)
        # Kept for good: what is destroyed while the events executor spins, it may still call.
        self._setters: dict[str, Client] = {}

    def subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], *, raw: bool = False
    ) -> None:
        """Call `callback` with every message, or with its bytes if `raw`, from the thread that spins."""
        self.create_subscription(kind, topic, callback, QoSProfile(depth=_DEPTH), raw=raw)

    def publisher(self, kind: type, topic: str) -> Publisher:
        """Publishes with a queue as long."""
        return self.create_publisher(kind, topic, QoSProfile(depth=_DEPTH))

    def set_parameters_of(
        self, node: str, processes: Sequence[subprocess.Popen[bytes]] = (), **values: object
    ) -> None:
        """Set parameters of `node`, which `processes` run.

        Raises:
            UwbMitigationError: it does not answer, or refuses one.
        """
        if node not in self._setters:
            self._setters[node] = self.create_client(SetParameters, f"{node}/set_parameters")
        client = self._setters[node]
        wait(client.service_is_ready, f"{node} does not answer", processes)
        named = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        future = client.call_async(SetParameters.Request(parameters=named))
        wait(future.done, f"{node} does not answer", processes)
        for result in future.result().results:
            if not result.successful:
                raise UwbMitigationError(f"{node}: {result.reason}")


def wait(
    condition: Callable[[], bool], failure: str, processes: Sequence[subprocess.Popen[bytes]] = ()
) -> None:
    """Wait until something holds.

    Raises:
        UwbMitigationError: `failure`: it does not, or a process has ended.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline or any(process.poll() is not None for process in processes):
            raise UwbMitigationError(failure)
        time.sleep(0.001)
