"""Calibration of one site from a drive: offsets, a correction and the check of the anchors."""
