"""The state of a node that continues after a crash."""

from __future__ import annotations

import pickle
import time
from pathlib import Path
from typing import Any

from uwb_mitigation.files import write_atomically

SAVE_PERIOD_S = 1.0

TRIAL_S = 5.0
"""A process with a loaded state saves nothing for this time: a state that leads to a crash is used once."""


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

    def load(self, max_age_s: float) -> Any:
        """Return the state that a crashed process saved; None: none, or older. Only the first call returns one."""
        is_first, self._is_first_load = self._is_first_load, False
        if self._path is None or not is_first or not self._path.is_file():
            return None
        try:
            age_s = time.time() - self._path.stat().st_mtime
            state = pickle.loads(self._path.read_bytes())
            self._path.unlink()
        except Exception as error:  # Damaged files raise anything.
            self._logger.warning(f"the state before the crash cannot be read: {error}")
            return None
        if age_s > max_age_s:
            return None
        self._next_save_s = time.monotonic() + TRIAL_S
        self._logger.info(f"continuing with the state of {age_s:.1f} s ago, before the crash")
        return state

    def save(self, state: Any) -> None:
        """Save a state, at most every `SAVE_PERIOD_S`."""
        now_s = time.monotonic()
        if self._path is None or now_s < self._next_save_s:
            return
        self._next_save_s = now_s + SAVE_PERIOD_S
        try:
            write_atomically(self._path, pickle.dumps(state))
        except Exception as error:  # Without it, the node only starts from scratch.
            self._logger.warning(f"the state cannot be saved: {error}")
            self._path = None
