"""Estimation from a whole recording: smoother, least squares, calibration, survey of anchors."""
