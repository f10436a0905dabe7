"""Topics of this package as recorded without a namespace, and their types."""

RANGE_RAW = "/uwb/range_raw"
RANGE_TRUTH = "/uwb/range_truth"
RANGE_CORRECTED = "/uwb/range_corrected"

POSE = "/uwb/pose"
ODOMETRY = "/uwb/odometry"
POSE_SMOOTHED = "/uwb/pose_smoothed"
ANCHORS = "/uwb/anchors"
ODOMETRY_TRUTH = "/uwb/odometry_truth"
"""True position of a tag, if the recording contains it; the child frame is `tag_` and its number."""

ROBOT_ODOMETRY = "/odom"
ROBOT_IMU = "/imu"
"""Odometry and IMU of a simulated robot, with the usual names."""

RANGE_CIR_TYPE = "uwb_mitigation_msgs/msg/RangeCir"
RANGE_TRUTH_TYPE = "uwb_mitigation_msgs/msg/RangeTruth"
RANGE_CORRECTED_TYPE = "uwb_mitigation_msgs/msg/RangeCorrected"
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
IMU_TYPE = "sensor_msgs/msg/Imu"
RANGE_SENSOR_TYPE = "sensor_msgs/msg/Range"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"
TF, TF_STATIC = "/tf", "/tf_static"
DIAGNOSTICS, CLOCK = "/diagnostics", "/clock"
PX4_ODOMETRY = "/fmu/in/vehicle_visual_odometry"
PX4_BEACON = "/fmu/in/ranging_beacon"
PX4_LOCAL_POSITION = "/fmu/out/vehicle_local_position"
TF_TYPE = "tf2_msgs/msg/TFMessage"

TYPES = {
    RANGE_RAW: RANGE_CIR_TYPE,
    RANGE_TRUTH: RANGE_TRUTH_TYPE,
    RANGE_CORRECTED: RANGE_CORRECTED_TYPE,
    POSE: POSE_TYPE,
    POSE_SMOOTHED: POSE_TYPE,
    ODOMETRY: ODOMETRY_TYPE,
    ODOMETRY_TRUTH: ODOMETRY_TYPE,
    ANCHORS: MARKERS_TYPE,
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
"""Types of what the viewer shows."""


def relative(topic: str) -> str:
    """Return the name that a node uses, so that the topic is in its namespace."""
    return topic.removeprefix("/")
