"""Benchmarks of the parts of the system on emulated boards and modelled chips: `python -m benchmarks`."""
