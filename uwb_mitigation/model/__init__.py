"""The model: its architecture, the bundle file that ships it, and the two ways to run it.

`bundle` is one ONNX file with its metadata inside, run with ONNX Runtime; `integer` is
the numpy oracle that ONNX Runtime and the firmware are tested against.
"""
