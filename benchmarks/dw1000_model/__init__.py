"""The model of the DW1000 in `firmware/dw1000_model`, from Python: airs, chips, links, and programs for their hosts."""
