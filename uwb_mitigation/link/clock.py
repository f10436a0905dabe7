"""A board's clock on the host's: offset and drift from what the link shows of both. No I/O.

What is known for certain bounds the estimate: a frame is never received before what it tells of, and a
round trip encloses the moment at which the board answered it. Within the bounds a Kalman filter with two
states, offset and drift, weighs each round trip by its duration, so that one delayed by a busy bus or
host hardly counts.
"""

from __future__ import annotations

import bisect

_FLOOR_NS = 20e3
"""Uncertainty of the best of exchanges: time stamps of both sides are not better."""

_LATE_ARRIVAL_NS = 20e6
"""How late a frame may well arrive: the weight of one-way arrivals while there was no round trip."""

_FIRST_ARRIVAL_NS = 1e6
"""Weight of the first arrival: if it was late, the next early one corrects it, whatever its weight."""

_START_DRIFT = 100e-6
"""Twice the tolerance of a common crystal."""

_DRIFT_WALK_PER_S = 1.7e-14
"""Variance that a second adds to the drift: one part in 10^6 a minute, as a warming crystal does."""

_OFFSET_WALK_NS2_PER_S = 1e6
"""Variance that a second adds to the offset: 1 us, for what the drift's walk does not cover."""

_STEP_NS = 100e6
"""A correction larger than this is a clock that was set, not one that drifts."""

_MAX_AGE_NS = 10 * 10**9
"""A measurement that seems older than this when it arrives is a fault of the board's clock."""

_HISTORY = 1024


class DeviceClock:
    """Maps a board's counter to the host's clock, strictly increasing.

    Args:
        tick_hz: rate of the counter.
        wrap: the counter's modulus, such as `DEVICE_TIME_WRAP`; None if it never wraps. A gap may hold
            any number of wraps: the host's clock tells how many.
    """

    def __init__(self, tick_hz: float = 1e6, wrap: int | None = None) -> None:
        self._ns_per_tick = 1e9 / tick_hz
        self._wrap = wrap
        self.reset()

    def reset(self) -> None:
        """Forget everything, as when the board started anew."""
        self._last: tuple[int, int] | None = None
        self._restart()

    def _restart(self) -> None:
        # Host time = board time + origin + offset, at board time `_at` (ns).
        self._origin: int | None = None
        self._at = 0
        self._offset = 0.0
        self._drift = 0.0
        self._p_offset = 0.0
        self._p_cross = 0.0
        self._p_drift = _START_DRIFT**2
        self._enclosed = False
        self._times: list[int] = []
        self._stamps: list[int] = []

    @property
    def synchronised(self) -> bool:
        """True once a round trip has bounded the estimate from both sides."""
        return self._enclosed

    @property
    def drift(self) -> float:
        """Seconds that the host's clock gains on the board's per second of the board's."""
        return self._drift

    @property
    def offset_ns(self) -> int:
        """Host's clock minus board's, at the last update; 0 before the first."""
        return (self._origin or 0) + round(self._offset)

    @property
    def uncertainty_ns(self) -> float:
        """Standard deviation of the estimate at the last update."""
        return float(max(self._p_offset, 0.0) ** 0.5)

    def arrival(self, ticks: int, arrived_ns: int) -> None:
        """Take note that a frame that tells of the counter value `ticks` was there at `arrived_ns`."""
        self._arrival(self._board_ns(ticks, arrived_ns), arrived_ns)

    def exchange(self, sent_ns: int, received: int, replied: int, arrived_ns: int) -> None:
        """Take note of a round trip: sent by the host, received and replied by the board, back again.

        A round trip that contradicts itself (shorter than the board's part in it) is ignored.
        """
        received_ns = self._board_ns(received, arrived_ns)
        replied_ns = self._board_ns(replied, arrived_ns)
        earliest = sent_ns - received_ns
        latest = arrived_ns - replied_ns
        if latest < earliest or replied_ns < received_ns:
            return
        if self._origin is None:
            self._origin = (earliest + latest) // 2
            self._at = received_ns
            self._p_offset = _LATE_ARRIVAL_NS**2
        at = (received_ns + replied_ns) // 2
        low, high = float(earliest - self._origin), float(latest - self._origin)
        variance = (high - low) ** 2 / 12 + _FLOOR_NS**2
        self._update(at, (low + high) / 2, variance)
        self._enclosed = True
        self._confine(at, low, high)

    def stamp(self, ticks: int, arrived_ns: int) -> int:
        """The host's time at `ticks`, of which a frame arrived at `arrived_ns`; ns.

        The same ticks give the same stamp again, later ticks a later stamp, and no stamp lies after the
        arrival: only a clock that was set or a board that was reset can move stamps back.
        """
        board_ns = self._board_ns(ticks, arrived_ns)
        self._arrival(board_ns, arrived_ns)
        index = bisect.bisect_left(self._times, board_ns)
        if index < len(self._times) and self._times[index] == board_ns:
            return self._stamps[index]
        stamp_ns = min(self._predict_ns(board_ns), arrived_ns)
        if index < len(self._stamps):
            stamp_ns = min(stamp_ns, self._stamps[index] - 1)
        if index > 0:
            stamp_ns = max(stamp_ns, self._stamps[index - 1] + 1)
        self._times.insert(index, board_ns)
        self._stamps.insert(index, stamp_ns)
        del self._times[:-_HISTORY], self._stamps[:-_HISTORY]
        return stamp_ns

    def _board_ns(self, ticks: int, host_ns: int) -> int:
        if self._wrap is not None:
            if self._last is not None:
                last_ticks, last_host_ns = self._last
                expected = last_ticks + round((host_ns - last_host_ns) / self._ns_per_tick)
                half = self._wrap // 2
                ticks = expected + (ticks - expected + half) % self._wrap - half
            self._last = (ticks, host_ns)
        return round(ticks * self._ns_per_tick)

    def _predict_ns(self, board_ns: int) -> int:
        origin = self._origin or 0
        return board_ns + origin + round(self._offset + self._drift * (board_ns - self._at))

    def _arrival(self, board_ns: int, arrived_ns: int) -> None:
        late_ns = 0 if self._origin is None else arrived_ns - self._predict_ns(board_ns)
        if late_ns > _MAX_AGE_NS:
            self._restart()
        if self._origin is None:
            self._origin = arrived_ns - board_ns
            self._at = board_ns
            self._p_offset = _FIRST_ARRIVAL_NS**2
            return
        high = float(arrived_ns - board_ns - self._origin)
        if late_ns < 0:
            self._update(board_ns, high, _FLOOR_NS**2)
            self._confine(board_ns, float("-inf"), high)
        elif not self._enclosed:
            # The later, the less it says: a stall of seconds must not count as an offset.
            self._update(board_ns, high, _LATE_ARRIVAL_NS**2 + late_ns**2)

    def _update(self, at: int, offset: float, variance: float) -> None:
        """The filter's step for a measured `offset` at board time `at`."""
        ahead = at - self._at
        if ahead > 0:
            ahead_s = ahead / 1e9
            self._offset += self._drift * ahead
            self._p_offset += ahead * (2 * self._p_cross + ahead * self._p_drift)
            self._p_offset += _OFFSET_WALK_NS2_PER_S * ahead_s
            self._p_cross += ahead * self._p_drift
            self._p_drift = min(self._p_drift + _DRIFT_WALK_PER_S * ahead_s, _START_DRIFT**2)
            self._at = at
            ahead = 0
        # A sample from before the last update is seen through the drift: H = [1, ahead].
        cross_offset = self._p_offset + ahead * self._p_cross
        cross_drift = self._p_cross + ahead * self._p_drift
        total = cross_offset + ahead * cross_drift + variance
        surprise = offset - (self._offset + self._drift * ahead)
        gain_offset, gain_drift = cross_offset / total, cross_drift / total
        self._offset += gain_offset * surprise
        self._drift += gain_drift * surprise
        self._p_offset -= gain_offset * cross_offset
        self._p_cross -= gain_offset * cross_drift
        self._p_drift -= gain_drift * cross_drift

    def _confine(self, at: int, low: float, high: float) -> None:
        """Move the estimate into what is certain; start anew where that is a step."""
        predicted = self._offset + self._drift * (at - self._at)
        nearest = min(max(predicted, low), high)
        if nearest == predicted:
            return
        if abs(nearest - predicted) > _STEP_NS:
            origin = (self._origin or 0) + round(nearest)
            enclosed = self._enclosed
            self._restart()
            self._origin, self._at, self._enclosed = origin, at, enclosed
            self._p_offset = _LATE_ARRIVAL_NS**2
            return
        self._offset += nearest - predicted
        self._p_offset = max(self._p_offset, (nearest - predicted) ** 2)
