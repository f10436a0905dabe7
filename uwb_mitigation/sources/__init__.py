"""Sources of measurements: recordings, radios and the simulator, with a common interface.

`source` defines the interface, each other module implements one kind of source, and `opening` selects it by path.
"""
