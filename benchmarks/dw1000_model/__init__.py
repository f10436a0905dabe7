"""The model of the DW1000 in `chip/`, from Python: airs, chips, links, and programs for their hosts."""
