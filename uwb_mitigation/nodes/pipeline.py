"""The node pair `pipeline`: driver and mitigator in one process.

A measurement goes from one to the other in memory; `/uwb/range_raw` is built and published only while
someone subscribes to it. Names, topics, parameters and diagnostics are those of the two nodes.
"""

from __future__ import annotations

import sys
import threading

from rclpy.node import Node

from uwb_mitigation.nodes import driver, mitigator
from uwb_mitigation.nodes.driver import Driver
from uwb_mitigation.nodes.mitigator import Mitigator
from uwb_mitigation.nodes.running import run


def make_nodes(ended: threading.Event) -> list[Node]:
    """The driver and the mitigator it hands its measurements to.

    Raises:
        UwbMitigationError: a parameter that neither can start with.
    """
    # Parameters on the command line reach both nodes.
    consumer = Mitigator(subscribe=False, foreign={row.name for row in driver.PARAMETERS})
    try:
        source = Driver(ended, consumer, foreign={row.name for row in mitigator.PARAMETERS})
    except BaseException:
        consumer.destroy_node()
        raise
    return [source, consumer]


def main() -> None:
    sys.exit(run(make_nodes))
