"""Positioning of tags from ranges to anchors: filter, smoothers, survey of anchors, and evaluation.

Estimation in metres and seconds on NumPy arrays, without ROS and files; used by live nodes and for recordings.
"""
