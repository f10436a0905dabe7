"""The nodes of `pipeline`: driver and mitigator in one process, and the locator where `anchors` is given.

A measurement goes from one to the other in memory; `/uwb/range_raw` is built and published only while
someone subscribes to it. Names, topics, parameters and diagnostics are those of the two nodes.
"""

from __future__ import annotations

import threading

from rclpy.node import Node

from uwb_mitigation.nodes.driver import Driver
from uwb_mitigation.nodes.locator import Locator
from uwb_mitigation.nodes.mitigator import Mitigator
from uwb_mitigation.nodes.parameter_tables import TABLES


def make_nodes(ended: threading.Event) -> list[Node]:
    """The driver and the mitigator it hands its measurements to; and a locator, where `anchors` is given.

    Raises:
        UwbMitigationError: a parameter that neither can start with.
    """
    # Parameters on the command line reach all nodes.
    names = {node: {row.name for row in table} for node, table in TABLES.items()}
    made: list[Node] = []
    try:
        consumer = Mitigator(subscribe=False, foreign=names["driver"] | names["locator"])
        made.append(consumer)
        made.insert(0, Driver(ended, consumer, foreign=names["mitigator"] | names["locator"]))
        # rclpy offers no other way to the parameters given.
        given = consumer._parameter_overrides.get("anchors")
        if given is not None and given.value:
            made.append(Locator(foreign=names["driver"] | names["mitigator"]))
    except BaseException:
        for node in made:
            node.destroy_node()
        raise
    return made
