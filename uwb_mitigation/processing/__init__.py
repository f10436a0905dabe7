"""Recorded bags to corrected bags: which, how one is made, and how many are made at once. No output to people here."""
