"""Calibration of one site from drives: offsets, a correction, positions of anchors and their check."""
