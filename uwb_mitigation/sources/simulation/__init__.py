"""A physical simulator of UWB ranging: propagation, a DW1000-like receiver, a flat to place them in.

Pure and seeded: no I/O, no ROS, no clock. `sources.simulated` turns it into measurements.
"""
