"""The rules of tf2's buffer that matter for robots: one parent per frame, lookups along the tree, interpolation left out.

tf2 itself is neither on PyPI nor in Debian for ROS 2.
"""

from __future__ import annotations

import numpy as np

Pose = tuple[np.ndarray, np.ndarray]


class LookupFailed(Exception):
    """The two frames are in different trees, or a frame has no transform at the time."""


class Buffer:
    """Keeps the transforms of each child frame. A new parent replaces the parent from its stamp on, as in tf2."""

    def __init__(self) -> None:
        self._history: dict[str, dict[int, tuple[str, np.ndarray]]] = {}

    def add(self, parent: str, child: str, stamp_ns: int, matrix: np.ndarray) -> None:
        self._history.setdefault(child, {})[stamp_ns] = (parent, matrix)

    def frames(self) -> set[str]:
        return set(self._history)

    def parents(self, child: str) -> set[str]:
        """Every parent that the frame has had."""
        return {parent for parent, _ in self._history.get(child, {}).values()}

    def lookup(self, target: str, source: str, stamp_ns: int) -> np.ndarray:
        """The pose of `source` in `target` as a 4 x 4 matrix."""
        up, down = self._to_root(source, stamp_ns), self._to_root(target, stamp_ns)
        for frame, matrix in up.items():
            if frame in down:
                return np.linalg.inv(down[frame]) @ matrix
        raise LookupFailed(f"{source} and {target} are not in one tree")

    def _to_root(self, frame: str, stamp_ns: int) -> dict[str, np.ndarray]:
        """The pose of a frame in each of its ancestors."""
        poses, matrix = {frame: np.eye(4)}, np.eye(4)
        while frame in self._history:
            earlier = [at for at in self._history[frame] if at <= stamp_ns]
            if not earlier:
                break
            frame, step = self._history[frame][max(earlier)]
            matrix = step @ matrix
            poses[frame] = matrix
        return poses
