"""Where measurements come from: recordings, radios and the simulator, behind one small interface.

`source` defines the interface; each other module is one kind of source; `opening` picks by path.
"""
