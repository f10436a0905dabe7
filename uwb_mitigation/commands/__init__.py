"""The sub-commands of `uwb-mitigation`, one module a group, named after it. Each parses options, calls the library and
shows the result; none holds logic of its own. Heavy imports stay inside the command functions, so that
`--help` answers at once.
"""
