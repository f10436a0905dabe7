"""The model: architecture, bundle file, and two ways to run it.

`bundle` runs an ONNX file that contains its metadata with ONNX Runtime. `integer` is the NumPy reference
implementation for testing ONNX Runtime and the firmware.
"""
