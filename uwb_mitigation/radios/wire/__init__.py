"""The wire protocol of boards with our firmware: layout, messages, framing, clock and session."""
