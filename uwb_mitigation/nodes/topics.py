"""Topic names and qualities of service (REP-2003).

The names are relative: `/uwb/range_raw` without a namespace, `/board1/uwb/range_raw` under `board1`.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

RANGE_RAW = "uwb/range_raw"
RANGE_CORRECTED = "uwb/range_corrected"
RANGE_TRUTH = "uwb/range_truth"
DIAGNOSTICS = "/diagnostics"
CLOCK = "/clock"

# A reader that stalls loses nothing until it is this many ranges behind: 1 s at 1 kHz.
RANGES = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
)
