"""Recordings: bags, DecaRanging logs, and files with a mapping; `opening` selects the reader by path."""
