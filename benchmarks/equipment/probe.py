"""A node for measurements: subscribes with a long queue, and sets parameters of other nodes."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from benchmarks.equipment.processes import _DEPTH, wait
from uwb_mitigation.errors import UwbMitigationError


class Probe(Node):
    """Subscribes with a long queue, and sets parameters of other nodes."""

    def __init__(self, context: Context) -> None:
        super().__init__("probe", context=context)
        # Keep the clients: the events executor may call a client that is destroyed while it spins.
        self._setters: dict[str, Client] = {}

    def subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], *, raw: bool = False
    ) -> None:
        """Call `callback` with every message, or with its bytes if `raw`, from the thread that spins."""
        self.create_subscription(kind, topic, callback, QoSProfile(depth=_DEPTH), raw=raw)

    def publisher(self, kind: type, topic: str) -> Publisher:
        """Return a publisher with a long queue."""
        return self.create_publisher(kind, topic, QoSProfile(depth=_DEPTH))

    def set_parameters_of(
        self, node: str, processes: Sequence[subprocess.Popen[bytes]] = (), **values: object
    ) -> None:
        """Set parameters of `node`, which is in `processes`.

        Raises:
            UwbMitigationError: the node does not answer, or refuses a value.
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
