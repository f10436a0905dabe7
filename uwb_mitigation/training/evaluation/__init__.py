"""Evaluation of corrections: metrics, splits by configuration, and baselines."""
