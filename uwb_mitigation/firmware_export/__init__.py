"""From an int8 model to C that computes the same bits: exact integer constants, the header, measurement.

Needs numpy, and for measurement a cross compiler and an emulator; neither ROS nor torch.
"""
