"""Where a tag is, from its ranges to anchors: filter, smoothers, survey of anchors, and how good they are.

Pure estimation in metres and seconds on numpy arrays: no ROS, no files. Live nodes and recordings share it.
"""
