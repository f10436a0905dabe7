"""Recordings: bags, DecaRanging logs, and files with a mapping; `formats` selects the reader by path."""
