"""The link to a board: wire protocol, board session, clock estimate, and an emulated board.

Everything but `emulated_board` works on bytes and times that it is handed; `docs/reference/protocol.md` is the
protocol in words.
"""
