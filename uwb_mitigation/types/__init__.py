"""Data that modules exchange: measurements, tracks, anchors, offsets and the protocol of sources. No I/O but anchor files."""
