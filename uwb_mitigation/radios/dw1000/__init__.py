"""Radios connected to this computer: the firmware's driver and exchange on a DW1000 on USB or SPI."""
