"""Measure how fast the simulator generates buildings as arrays.

Argument: the number of placements. 100,352 placements took 102 s on two busy cores.
"""

import sys
import time

from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.simulation.buildings import PLACEMENTS
from uwb_mitigation.training.data.simulated import building_dataset

if __name__ == "__main__":
    blocks = -(-int(sys.argv[1]) // PLACEMENTS)
    wall = time.monotonic()
    made = len(building_dataset(1, blocks, Preprocessing(), workers=2))
    print(f"{made} ranges of {blocks * PLACEMENTS} placements in {time.monotonic() - wall:.0f} s")
