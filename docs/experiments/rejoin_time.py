"""Measure the time until a node that was killed receives or publishes its first range again.

Compares the mitigator with a subscription in plain rclpy, and a driver that waits for three subscribers with a publisher in
plain rclpy. Most of the time is DDS discovery: Fast DDS announces a new participant five times within 0.5 s and then every 3 s.

Argument: the number of repetitions (8).
"""

import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.simulation.simulated import SimulatedSource

BARE = """
import rclpy, time
from rclpy.node import Node
from uwb_mitigation_msgs.msg import RangeCir
rclpy.init(); node, got = Node("bare"), []
node.create_subscription(RangeCir, "/uwb/range_raw", got.append, 1000)
print("ready", flush=True)
while not got: rclpy.spin_once(node, timeout_sec=0.01)
print("joined", flush=True); time.sleep(600)
"""
BARE_PUBLISHER = """
import rclpy, time
from rclpy.node import Node
from uwb_mitigation_msgs.msg import RangeCir
rclpy.init(); node = Node("bare_publisher")
publisher = node.create_publisher(RangeCir, "/uwb/range_raw", 1000)
print("ready", flush=True)
while publisher.get_subscription_count() < 3: rclpy.spin_once(node, timeout_sec=0.01)
print("joined", flush=True); time.sleep(600)
"""
times = int(sys.argv[1]) if len(sys.argv) > 1 else 8
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
bag = Path(tempfile.mkdtemp(), "ranges.mcap")
with BagWriter(bag, {"source": "simulated", "simulated": "true"}) as writer:
    for record in itertools.islice(SimulatedSource(seed=1, rate_hz=100.0), 20_000):
        writer.write(record)
COMMANDS = {
    "mitigator": ["mitigator"],
    "plain subscription": [sys.executable, "-c", BARE],
    "driver": [
        *["driver", "--ros-args", "-p", "source:=mcap", "-p", "wait_for_subscribers:=3", "-p"],
        f"path:={bag}",
    ],
    "plain publisher": [sys.executable, "-c", BARE_PUBLISHER],
}
rclpy.init()
client, received = Node("client"), {"raw": 0, "corrected": 0}


def count(name: str) -> None:
    received[name] += 1


client.create_subscription(RangeCir, "/uwb/range_raw", lambda _: count("raw"), 1000)
client.create_subscription(RangeCorrected, "/uwb/range_corrected", lambda _: count("corrected"), 1000)


def start(name: str) -> subprocess.Popen[str]:
    return subprocess.Popen(COMMANDS[name], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for(name: str) -> None:
    received[name] = 0
    while not received[name]:
        rclpy.spin_once(client, timeout_sec=0.01)


def come_back(name: str) -> tuple[float, float]:
    """Kill and restart a node; return the times until it is ready and until its first range, s."""
    running[name].kill()
    running[name].wait()
    until_s = time.monotonic() + 0.5
    while time.monotonic() < until_s:
        rclpy.spin_once(client, timeout_sec=0.01)
    began_s = time.monotonic()
    running[name] = start(name)
    output: Any = running[name].stdout
    output.readline()  # model loaded, subscription created, recording open
    ready_s = time.monotonic() - began_s
    if name.startswith("plain"):
        output.readline()
    else:
        wait_for("corrected" if name == "mitigator" else "raw")
    return ready_s, time.monotonic() - began_s


running = {name: start(name) for name in COMMANDS}
try:
    wait_for("corrected")
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    for _ in range(times):
        for name in COMMANDS:
            measured[name].append(come_back(name))
    for name, pairs in measured.items():
        ready, first = zip(*pairs, strict=True)
        print(
            f"{name}: ready {min(ready):.2f} to {max(ready):.2f} s, median {statistics.median(ready):.2f}; "
            f"first range {min(first):.2f} to {max(first):.2f} s, median {statistics.median(first):.2f}"
        )
finally:
    for node in running.values():
        node.terminate()
