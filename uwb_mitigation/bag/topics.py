"""The topics that this package writes, and their types."""

RANGE_RAW = "/uwb/range_raw"
RANGE_TRUTH = "/uwb/range_truth"
RANGE_CORRECTED = "/uwb/range_corrected"

RANGE_CIR_TYPE = "uwb_mitigation_msgs/msg/RangeCir"
RANGE_TRUTH_TYPE = "uwb_mitigation_msgs/msg/RangeTruth"
RANGE_CORRECTED_TYPE = "uwb_mitigation_msgs/msg/RangeCorrected"
