"""Boards with Qorvo's UCI firmware (DWM3001CDK and others): packets, sessions, and the thread that operates a board."""
