"""The link to a board: wire protocol, board session, clock estimate, and an emulated board.

Only `connection`, `port` and `emulated_board` do I/O. `docs/reference/protocol.md` describes the protocol.
"""
