"""Estimation from a whole recording: least squares, smoother."""
