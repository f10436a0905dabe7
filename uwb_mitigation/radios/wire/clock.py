"""Estimate of the offset and drift between a board's clock and the host's clock. No I/O.

Causality bounds the estimate: a frame never arrives before the event that it reports, and the board answers
between the start and the end of a round trip. Within these bounds, a Kalman filter with the states offset
and drift weighs each round trip by its duration: round trips that a busy bus or host delays have little weight.
"""

from __future__ import annotations

import bisect

from uwb_mitigation.types.stamps import NS_PER_S

_FLOOR_NS = 20e3
"""Standard deviation of the best round trip, limited by the timestamps of both sides."""

_LATE_ARRIVAL_NS = 20e6
"""Typical delay of a frame: standard deviation of one-way arrivals before the first round trip."""

_FIRST_ARRIVAL_NS = 1e6
"""Standard deviation of the first arrival. If it was late, the next early arrival corrects the estimate."""

_INITIAL_DRIFT_SD = 100e-6
"""Twice the tolerance of a common crystal."""

_DRIFT_WALK_PER_S = 1.7e-14
"""Process noise of the drift, variance per second: 1 ppm per minute, as for a crystal that warms up."""

_OFFSET_WALK_NS2_PER_S = 1e6
"""Process noise of the offset, variance per second: 1 us, for errors that the drift does not model."""

_STEP_NS = 100e6
"""A larger correction means that a clock was set."""

_MAX_AGE_NS = 10 * NS_PER_S
"""If a measurement is older than this when it arrives, the board's clock is wrong."""

_MAX_HISTORY = 1024


class DeviceClock:
    """Strictly increasing map from a board's uptime in microseconds to the host's clock.

    Attributes:
        synchronised: a round trip has bounded the estimate from both sides.
        drift: seconds that the host's clock gains per second of the board's clock.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset the estimate, for example after the board was restarted."""
        # Host time = board time + origin + offset, at board time `_updated_ns`.
        self._origin: int | None = None
        self._updated_ns = 0
        self._offset = 0.0
        self.drift = 0.0
        self._p_offset = 0.0
        self._p_cross = 0.0
        self._p_drift = _INITIAL_DRIFT_SD**2
        self.synchronised = False
        self._times: list[int] = []
        self._stamps: list[int] = []

    @property
    def offset_ns(self) -> int:
        """Host's clock minus board's, at the last update; 0 before the first."""
        return (self._origin or 0) + round(self._offset)

    @property
    def uncertainty_ns(self) -> float:
        """Standard deviation of the estimate at the last update."""
        return float(max(self._p_offset, 0.0) ** 0.5)

    def arrival(self, uptime_us: int, arrived_ns: int) -> None:
        """Add a frame that reports an event at `uptime_us` and arrived at `arrived_ns`."""
        board_ns = 1000 * uptime_us
        late_ns = 0 if self._origin is None else arrived_ns - self._predict_ns(board_ns)
        if late_ns > _MAX_AGE_NS:
            self.reset()
        if self._origin is None:
            self._origin = arrived_ns - board_ns
            self._updated_ns = board_ns
            self._p_offset = _FIRST_ARRIVAL_NS**2
            return
        high = float(arrived_ns - board_ns - self._origin)
        if late_ns < 0:
            self._update(board_ns, high, _FLOOR_NS**2)
            self._clip(board_ns, float("-inf"), high)
        elif not self.synchronised:
            # A late arrival has a small weight, so that a stall of seconds does not change the offset.
            self._update(board_ns, high, _LATE_ARRIVAL_NS**2 + late_ns**2)

    def exchange(self, sent_ns: int, received_us: int, replied_us: int, arrived_ns: int) -> None:
        """Add a round trip: the host sends, the board receives and replies, the host receives the reply.

        Inconsistent round trips (shorter than the time between the board's reception and reply) are ignored.
        """
        received_ns, replied_ns = 1000 * received_us, 1000 * replied_us
        earliest = sent_ns - received_ns
        latest = arrived_ns - replied_ns
        if latest < earliest or replied_ns < received_ns:
            return
        if self._origin is None:
            self._origin = (earliest + latest) // 2
            self._updated_ns = received_ns
            self._p_offset = _LATE_ARRIVAL_NS**2
        board_ns = (received_ns + replied_ns) // 2
        low, high = float(earliest - self._origin), float(latest - self._origin)
        variance = (high - low) ** 2 / 12 + _FLOOR_NS**2
        self._update(board_ns, (low + high) / 2, variance)
        self.synchronised = True
        self._clip(board_ns, low, high)

    def stamp(self, uptime_us: int, arrived_ns: int) -> int:
        """Return the host's time, ns, at `uptime_us`, the event time of a frame that arrived at `arrived_ns`.

        The same uptime always maps to the same stamp, a later one to a later stamp, and no stamp is after the
        arrival. Stamps move back only after a clock was set or a board was reset.
        """
        board_ns = 1000 * uptime_us
        self.arrival(uptime_us, arrived_ns)
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
        del self._times[:-_MAX_HISTORY], self._stamps[:-_MAX_HISTORY]
        return stamp_ns

    def _predict_ns(self, board_ns: int) -> int:
        origin = self._origin or 0
        return board_ns + origin + round(self._offset + self.drift * (board_ns - self._updated_ns))

    def _update(self, board_ns: int, offset: float, variance: float) -> None:
        """Update the filter with a measured `offset` at board time `board_ns`."""
        dt_ns = board_ns - self._updated_ns
        if dt_ns > 0:
            dt_s = dt_ns / 1e9
            self._offset += self.drift * dt_ns
            self._p_offset += dt_ns * (2 * self._p_cross + dt_ns * self._p_drift)
            self._p_offset += _OFFSET_WALK_NS2_PER_S * dt_s
            self._p_cross += dt_ns * self._p_drift
            self._p_drift = min(self._p_drift + _DRIFT_WALK_PER_S * dt_s, _INITIAL_DRIFT_SD**2)
            self._updated_ns = board_ns
            dt_ns = 0
        # The sample may be older than the last update: the measurement matrix is H = [1, dt_ns].
        cross_offset = self._p_offset + dt_ns * self._p_cross
        cross_drift = self._p_cross + dt_ns * self._p_drift
        total = cross_offset + dt_ns * cross_drift + variance
        innovation = offset - (self._offset + self.drift * dt_ns)
        gain_offset, gain_drift = cross_offset / total, cross_drift / total
        self._offset += gain_offset * innovation
        self.drift += gain_drift * innovation
        self._p_offset -= gain_offset * cross_offset
        self._p_cross -= gain_offset * cross_drift
        self._p_drift -= gain_drift * cross_drift

    def _clip(self, board_ns: int, low: float, high: float) -> None:
        """Clip the estimate to its bounds; restart the filter if the correction is a clock step."""
        predicted = self._offset + self.drift * (board_ns - self._updated_ns)
        nearest = min(max(predicted, low), high)
        if nearest == predicted:
            return
        if abs(nearest - predicted) > _STEP_NS:
            origin = (self._origin or 0) + round(nearest)
            enclosed = self.synchronised
            self.reset()
            self._origin, self._updated_ns, self.synchronised = origin, board_ns, enclosed
            self._p_offset = _LATE_ARRIVAL_NS**2
            return
        self._offset += nearest - predicted
        self._p_offset = max(self._p_offset, (nearest - predicted) ** 2)
