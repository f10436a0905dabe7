"""Load ROS with its middleware and the messages, and print the middleware; `doctor` runs this as a process."""

from rclpy.utilities import get_rmw_implementation_identifier
from uwb_mitigation_msgs.msg import RangeCir

if __name__ == "__main__":
    # Load the C libraries of the messages, too.
    RangeCir.__class__.__import_type_support__()
    print(get_rmw_implementation_identifier())
