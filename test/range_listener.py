"""A subscriber that knows only the ROS API: prints the corrected ranges it receives as JSON lines.

range_listener.py COUNT    ends after COUNT raw and as many corrected ranges; those of tag 0 only show that it is connected
"""

import json
import sys

import rclpy
from rclpy.node import Node
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected


def main() -> None:
    wanted = int(sys.argv[1])
    rclpy.init()
    node = Node("range_listener")
    seen = {"raw": 0, "corrected": 0}

    def note(kind, message):
        seen[kind] += message.tag_id != 0
        stamp = message.header.stamp
        line = {
            "kind": kind,
            "stamp": [stamp.sec, stamp.nanosec],
            "frame_id": message.header.frame_id,
            "sequence": message.sequence,
            "pair": [message.anchor_id, message.tag_id],
            "range": message.range,
        }
        if kind == "corrected":
            line |= {
                "range_raw": message.range_raw,
                "correction": message.correction,
                "variance": message.variance,
                "status": message.status,
                "source": message.source,
                "model_id": message.model_id,
            }
        print(json.dumps(line), flush=True)

    node.create_subscription(RangeCir, "/uwb/range_raw", lambda m: note("raw", m), 1000)
    node.create_subscription(RangeCorrected, "/uwb/range_corrected", lambda m: note("corrected", m), 1000)
    print(json.dumps({"kind": "ready"}), flush=True)
    while min(seen.values()) < wanted:
        rclpy.spin_once(node, timeout_sec=0.5)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
