"""How good a correction is: metrics, splits by configuration, and the baselines it must beat."""
