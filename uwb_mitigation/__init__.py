"""Range error mitigation for ultra-wideband radios.

The names most callers need live one level down: `measurement` (what a range is), `sources` (where
ranges come from), `mitigation` (a range in, a corrected range out) and `nodes` (the same over ROS 2).
Importing this package needs neither ROS nor torch.
"""

__version__ = "0.1.0"
