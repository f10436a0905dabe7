"""Whether two models give the same corrected ranges: what is compared, and what came of it. No ROS."""

from __future__ import annotations

import struct
import threading
from collections.abc import Hashable

from uwb_mitigation.measurement import CorrectedRange

WAITING = 4096
"""Ranges that wait for their counterpart; older ones are given up, and counted as unmatched."""

# As the messages carry them: equal means equal bits, a NaN included.
_BITS = struct.Struct("<ffffBI")


class Agreement:
    """Pairs the board's corrected ranges with the host's, bit by bit; may be fed by two threads.

    Attributes:
        equal, different: pairs whose bits agree or differ.
        unmatched: ranges whose counterpart never came.
    """

    def __init__(self) -> None:
        self.equal = 0
        self.different = 0
        self.unmatched = 0
        self._lock = threading.Lock()
        self._waiting: dict[tuple[bool, Hashable], bytes] = {}

    def add_device(self, key: Hashable, corrected: CorrectedRange) -> None:
        self._add(True, key, corrected)

    def add_host(self, key: Hashable, corrected: CorrectedRange) -> None:
        self._add(False, key, corrected)

    def facts(self) -> dict[str, object]:
        """For the diagnostics."""
        return {
            "board and host agree": self.equal,
            "board and host differ": self.different,
            "corrected by one alone": self.unmatched,
        }

    def _add(self, device: bool, key: Hashable, corrected: CorrectedRange) -> None:
        bits = _BITS.pack(
            corrected.range_m,
            corrected.range_raw_m,
            corrected.correction_m,
            corrected.variance_m2,
            corrected.status,
            corrected.model_id,
        )
        with self._lock:
            other = self._waiting.pop((not device, key), None)
            if other is None:
                self._waiting[device, key] = bits
                if len(self._waiting) > WAITING:
                    self._waiting.pop(next(iter(self._waiting)))
                    self.unmatched += 1
            elif other == bits:
                self.equal += 1
            else:
                self.different += 1
