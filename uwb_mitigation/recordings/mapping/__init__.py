"""Mapping files: tables and messages of other software as recordings of ranges."""
