"""Emulated boards, faults, and a model of the DW1000: used by benchmarks and tests in place of hardware."""
