"""Correction of ranges: preprocessing, models, and the export for boards."""
