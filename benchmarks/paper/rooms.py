"""DeepUWB's rooms and materials in the names of configurations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.training.data.deepuwb import MATERIALS, NO_MATERIAL

ROOM_ROWS = (954, 18_422, 13_210, 17_601, 4_971)
"""Published number of rows of each room."""

_NAME = re.compile(r"(?:simulated seed [0-9]+/)?deepuwb/room([0-4])/([^/]+)(?:/placement [0-9]+)?")


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
    materials = tuple(match[2].split("+")) if match and match[2] != NO_MATERIAL else ()
    if match is None or not set(materials) <= set(MATERIALS):
        raise DatasetError(
            f"configuration {name[:80]!r} is not from DeepUWB", valid="such as 'deepuwb/room2/wall+plastic'"
        )
    return int(match[1]), materials
