"""A physical simulator of UWB ranging: propagation, a DW1000-like receiver, and buildings.

Deterministic for a seed: no I/O, no ROS, no clock. `sources.simulated` generates measurements from it.
"""
