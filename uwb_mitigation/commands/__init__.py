"""The sub-commands of `uwb-mitigation`, one module for each group.

Each parses options, calls the library and shows the result; the logic is in the library. Heavy imports are inside
the command functions, so that `--help` is fast.
"""
