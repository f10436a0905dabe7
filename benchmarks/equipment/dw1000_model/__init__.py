"""Python interface to the model of the DW1000 in `chip/`: air, chips, links, and host programs."""
