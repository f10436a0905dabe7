"""Measure what the parts of the system can do, on emulated boards and modelled chips: `python -m benchmarks`."""
