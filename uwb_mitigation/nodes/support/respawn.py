"""What a node leaves for the process that replaces it after a crash.

The file of a `StateFile` has the keys `format` (`FORMAT`), `saved_s` (Unix time) and `state`, whose keys the node defines.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.files import partial_path, read_bounded, write_atomically

FORMAT, MAX_BYTES = 1, 1 << 16
SAVE_PERIOD_S = 0.2

TRIAL_S = 5.0
"""A process with a loaded state saves nothing for this time: a state that leads to a crash becomes too old."""

State = TypeVar("State")


class RespawnState:
    """Whether an earlier process of a driver was started or ended, in a file that contains its exit code.

    Args:
        path: in the folder of a running launch file; None: the driver is not respawned.

    Attributes:
        is_respawned: this process replaces an earlier one.
        exit_code: the exit code with which the earlier process has ended a recording; None: it has not. The launch
            file may respawn the driver before it handles its exit.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        text = path.read_text(encoding="ascii") if path is not None and path.is_file() else None
        self.is_respawned = text is not None
        self.exit_code = int(text) if text else None
        self.save(self.exit_code)

    def save(self, exit_code: int | None) -> None:
        """Let a process that replaces this one end with the same exit code; None: it continues."""
        if self._path is not None:
            # Without the file, a respawned driver only starts from scratch.
            with contextlib.suppress(OSError):
                self._path.write_text("" if exit_code is None else str(exit_code), encoding="ascii")


def unused_path(path: Path) -> Path:
    """Return the first of NAME, NAME_2, NAME_3 ... that does not exist and is not a partly written file.

    A device or pipe is returned unchanged.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        return path
    names = chain([path.name], (f"{path.stem}_{number}{path.suffix}" for number in count(2)))
    paths = map(path.with_name, names)
    return next(path for path in paths if not (os.path.lexists(path) or partial_path(path).exists()))


class StateFile:
    """Saves a state periodically, and returns it once to the process that replaces a crashed one.

    Args:
        path: in the folder of a running launch file, which only its user can write; None: save nothing.
        logger: with `info` and `warning`, as rclpy's.
    """

    def __init__(self, path: Path | None, logger: Any) -> None:
        self._path, self._logger = path, logger
        self._is_first_load = True
        self._next_save_s = 0.0

    def load(self, max_age_s: float, read: Callable[[Any], State]) -> State | None:
        """Return the state that a crashed process saved; None: none, or older. Only the first call returns one.

        Args:
            max_age_s: of the state.
            read: checks the state; raises KeyError, TypeError or ValueError if it is invalid.
        """
        is_first, self._is_first_load = self._is_first_load, False
        if self._path is None or not is_first or not self._path.is_file():
            return None
        try:
            document = json.loads(read_bounded(self._path, MAX_BYTES, UwbMitigationError))
            age_s = time.time() - document["saved_s"]
            if document["format"] != FORMAT:
                raise ValueError(f"format {document['format']} instead of {FORMAT}")
            if not -SAVE_PERIOD_S <= age_s <= max_age_s:
                return None
            state = read(document["state"])
        except (UwbMitigationError, KeyError, OverflowError, TypeError, ValueError) as error:
            self._logger.warning(f"the state before the crash cannot be read: {error}")
            return None
        self._next_save_s = time.monotonic() + TRIAL_S
        self._logger.info(f"continuing with the state of {age_s:.1f} s ago, before the crash")
        return state

    def save(self, state: Callable[[], Any]) -> None:
        """Save what `state` returns, at most every `SAVE_PERIOD_S`."""
        now_s = time.monotonic()
        if self._path is None or now_s < self._next_save_s:
            return
        self._next_save_s = now_s + SAVE_PERIOD_S
        document = {"format": FORMAT, "saved_s": time.time(), "state": state()}
        try:
            write_atomically(self._path, json.dumps(document))
        except UwbMitigationError as error:  # Without it, the node only starts from scratch.
            self._logger.warning(f"the state cannot be saved: {error}")
            self._path = None
