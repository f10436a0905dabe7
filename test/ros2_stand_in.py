"""Replacement for the command `ros2` without ROS: `run` of our nodes, `bag record` of ranges, `param set`.

`ros2 bag record` ends after the number of messages in $RECORDED_RANGES, as after Ctrl-C.
"""

import os
import sys
import threading
from pathlib import Path

from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE


def run(words: list[str]) -> None:
    package, node, *rest = words
    assert package == "uwb_mitigation", package
    os.execv(sys.executable, [sys.executable, "-m", "uwb_mitigation.commands.entry", node, *rest])


def record(words: list[str]) -> None:
    import rclpy
    from rclpy.qos import QoSProfile
    from uwb_mitigation_msgs.msg import RangeCir

    storage, output, topic = words[1], words[3], words[4]
    assert (words[0], words[2], storage, len(words)) == ("-s", "-o", "mcap", 5), words
    settings = os.environ["RECORDED_RANGES"].split()
    wanted, done = int(settings[1 + settings.index(output)]), threading.Event()
    rclpy.init()
    node = rclpy.create_node("recorder")
    with BagWriter(Path(output), {}) as out:

        def take(data: bytes) -> None:
            if not done.is_set():
                out.write_message(topic, RANGE_CIR_TYPE, data, node.get_clock().now().nanoseconds)
                if sum(out.counts.values()) >= wanted:
                    done.set()

        node.create_subscription(RangeCir, topic, take, QoSProfile(depth=1000), raw=True)
        while not done.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)


def set_parameter(words: list[str]) -> None:
    import rclpy
    import yaml
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    name, parameter, value = words
    rclpy.init()
    node = rclpy.create_node("setter")
    client = node.create_client(SetParameters, f"{name}/set_parameters")
    assert client.wait_for_service(60.0), f"no node {name}"
    given = Parameter(parameter, value=yaml.safe_load(value)).to_parameter_msg()
    asked = client.call_async(SetParameters.Request(parameters=[given]))
    rclpy.spin_until_future_complete(node, asked, timeout_sec=60.0)
    (result,) = asked.result().results
    assert result.successful, result.reason


VERBS = {"run": run, "bag record": record, "param set": set_parameter}

for verb, act in VERBS.items():
    head = verb.split()
    if sys.argv[1 : 1 + len(head)] == head:
        act(sys.argv[1 + len(head) :])
        break
else:
    sys.exit(f"the stand-in for ros2 knows {', '.join(VERBS)}, not {' '.join(sys.argv[1:])}")
