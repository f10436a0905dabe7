"""Radios: one module for each source (`serial`, `evb1000`, `spi`, `uci`), their port, settings and protocols."""
