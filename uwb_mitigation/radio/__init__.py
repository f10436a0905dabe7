"""Radios at this computer: the firmware's driver and exchange on a DW1000 that hangs on USB or SPI, or is modelled."""
