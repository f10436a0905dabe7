"""A node in a process of its own that was forked with most of its imports done: half a second less for each.

From there on it is what `ros2 run` starts: its own arguments, environment, main thread, DDS participant and end.
"""

from __future__ import annotations

import ctypes
import os
import sys
import traceback
from pathlib import Path

# Not rclpy itself nor ONNX Runtime: loading them starts threads, which a fork would lose.
PRELOADED = [
    "uwb_mitigation.nodes.entry",
    "uwb_mitigation.bag.codec",
    "uwb_mitigation.link.port",
    "uwb_mitigation.sources.mcap",
    "uwb_mitigation.sources.simulated",
    "diagnostic_msgs.msg",
    "lifecycle_msgs.srv",
    "rcl_interfaces.srv",
    "rosgraph_msgs.msg",
    "std_msgs.msg",
    "type_description_interfaces.srv",
    "uwb_mitigation_msgs.msg",
    "yaml",
]


def run(node: str, words: list[str], domain: int, log: Path) -> None:
    """Run in a process that was just forked; never returns."""
    with log.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout.reconfigure(line_buffering=True)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    sys.argv = [node, *words]
    code = 0
    try:
        from uwb_mitigation.nodes import entry

        getattr(entry, node)()
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    # Torn down in full, as at the end of a script: multiprocessing would leave that to the kernel.
    ctypes.pythonapi.Py_Exit(code)
