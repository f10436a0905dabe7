"""The paper's experiment, tables and figures, with DeepUWB and its simulated stand-in. `python -m benchmarks paper`."""
