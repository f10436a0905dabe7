"""Export of int8 models to C with bit-identical results: exact integer constants, the header, measurement.

Depends on numpy and, for measurements, on a cross compiler and an emulator; not on ROS or torch.
"""
