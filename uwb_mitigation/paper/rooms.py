"""DeepUWB's rooms and materials, the configuration names that contain them, and the train/test splits by room."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.evaluation.splits import Split, by_configuration

ROOMS = ("cross-room", "big room", "medium room", "small room", "outdoor")
"""Index: the value of the column `Room`."""

ROOM_ROWS = (954, 18_422, 13_210, 17_601, 4_971)
"""Published number of rows of each room."""

MATERIALS = (
    "wall",
    "polystyrene plate",
    "plastic",
    "plywood plate",
    "cardboard box",
    "LCD TV",
    "metal plate",
    "wood door",
    "glass plate",
    "metal window",
)
"""Index: the position of the character in the column `Obstacles`. All characters 0: LOS."""

AUTO, PAPER, CONFIGURATIONS = "auto", "paper", "configurations"
TRAINING_ROOMS = {PAPER: (1, 3), "all_but_room_2": (0, 1, 3, 4)}
"""{split: rooms to train on}. Both are tested in the medium room. `paper` has 36,023 training and 13,210 test rows;
`all_but_room_2` has 41,948 training rows and is used by later work."""

TEST_ROOM = 2
SPLITS = (AUTO, CONFIGURATIONS, *TRAINING_ROOMS)
FOLDS = 4
"""Of data without rooms; one fold is the test part."""

_NAME = re.compile(r"(?:simulated seed [0-9]+/)?deepuwb/room([0-4])/([^/]+)(?:/placement [0-9]+)?")
_NO_MATERIAL = "clear"


def configuration_of(room: int, obstacles: str) -> str:
    """Return the configuration name of a row: `deepuwb/room2/wall+metal plate`, `deepuwb/room1/clear`."""
    present = [material for material, digit in zip(MATERIALS, obstacles, strict=True) if digit == "1"]
    return f"deepuwb/room{room}/{'+'.join(present) or _NO_MATERIAL}"


def has_rooms(configurations: Sequence[str] | NDArray[np.str_]) -> bool:
    """Whether all configuration names are DeepUWB's or those of its simulated stand-in."""
    return all(_NAME.fullmatch(str(name)) for name in np.unique(np.asarray(configurations, np.str_)))


@cache
def parse_configuration(name: str) -> tuple[int, tuple[str, ...]]:
    """Return the room and the materials in the path (empty: LOS) of a configuration name.

    Raises:
        DatasetError: the name is not one of DeepUWB's.
    """
    match = _NAME.fullmatch(name)
    materials = tuple(match[2].split("+")) if match and match[2] != _NO_MATERIAL else ()
    if match is None or not set(materials) <= set(MATERIALS):
        raise DatasetError(
            f"configuration {name[:80]!r} is not from DeepUWB", valid="such as 'deepuwb/room2/wall+plastic'"
        )
    return int(match[1]), materials


def room_of(name: str) -> int:
    """Return the room (index into `ROOMS`); raises as `parse_configuration`."""
    return parse_configuration(name)[0]


def split_by_name(configurations: NDArray[np.str_], name: str) -> tuple[str, Split]:
    """Return one of `SPLITS` and its description. AUTO is `paper` for DeepUWB, otherwise `configurations`.

    Raises:
        ParameterError: unknown split.
        DatasetError: a part is empty, or the configurations have no rooms.
    """
    if name not in SPLITS:
        raise ParameterError(f"split {name!r}", valid=", ".join(SPLITS))
    if name == AUTO:
        name = PAPER if has_rooms(configurations) else CONFIGURATIONS
    if name == CONFIGURATIONS:
        fold = by_configuration(configurations, FOLDS, seed=0)[0]
        return f"{CONFIGURATIONS}: 1 of {FOLDS} parts held out", fold
    rooms = np.array([room_of(str(one)) for one in configurations], np.intp)
    train, test = np.flatnonzero(np.isin(rooms, TRAINING_ROOMS[name])), np.flatnonzero(rooms == TEST_ROOM)
    if not (len(train) and len(test)):
        raise DatasetError(
            f"split {name!r}: {len(train)} training rows and {len(test)} test rows",
            valid=f"rows of room {TEST_ROOM} and of rooms {TRAINING_ROOMS[name]}",
        )
    return name, Split(train, test)
