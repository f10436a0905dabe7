"""Processing of recordings in bulk: correction, tracks, parallel work."""
