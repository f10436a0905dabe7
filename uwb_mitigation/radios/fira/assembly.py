"""Measurements of a UCI board, assembled from its notifications. No I/O."""

from __future__ import annotations

import math
from collections import Counter, deque

from uwb_mitigation.radios.fira import codes
from uwb_mitigation.radios.fira.cir import PositionUnit, read_cir
from uwb_mitigation.radios.fira.codes import STATUS_OK
from uwb_mitigation.radios.fira.joining import MIN_TIMEOUT_NS, RangeArrival
from uwb_mitigation.radios.fira.messages import RangeNotification
from uwb_mitigation.radios.fira.packets import Packet
from uwb_mitigation.radios.fira.ranging import PeerSession, Ranging
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.types.measurement import RangeMeasurement

LATEST_NOTIFICATIONS = 16
"""Number of notifications among which repetitions are detected."""


class Assembly:
    """Joins ranges with their diagnostics, and returns measurements in the order of their arrival.

    Args:
        ranging: the sessions of the board.
        counts: numbers of messages and problems, which it increases.

    Attributes:
        failures: number of failed exchanges that were not taken yet, {cause: count}.
        clock_offsets_ppm: latest carrier frequency offsets of the peers.
        position_unit: unit of the first-path positions.
        has_ranged: a range of a session has arrived since the last start.
    """

    def __init__(self, ranging: Ranging, counts: Counter[str]) -> None:
        self.failures: Counter[str] = Counter()
        self.clock_offsets_ppm: deque[float] = deque(maxlen=200)
        self.position_unit = PositionUnit()
        self.has_ranged = False
        self._ranging, self._counts = ranging, counts
        self._arrivals: deque[tuple[PeerSession, RangeArrival]] = deque()
        self._notifications: deque[bytes] = deque(maxlen=LATEST_NOTIFICATIONS)

    def forget(self) -> None:
        """Complete all ranges: their sessions were lost."""
        for _, arrival in self._arrivals:
            arrival.is_complete = True
        self.has_ranged = False

    def begin(self) -> None:
        """Accept notifications that are equal to earlier ones: their numbers start again with a session."""
        self._notifications.clear()

    def add(self, packet: Packet, damages: int, now_ns: int, stamp_ns: int) -> None:
        """Add a notification of ranges or diagnostics; `damages` is the number of damaged places so far."""
        content = packet.content
        if packet.payload in self._notifications:
            self._counts["duplicates"] += 1
            return
        self._notifications.append(packet.payload)
        session = self._ranging.find(content.handle) if content is not None else None
        if isinstance(content, RangeNotification):
            for record in content.records:
                if session is None or record.peer != session.peer:
                    self._counts["unknown_session"] += 1
                    continue
                self.has_ranged = True
                arrival = RangeArrival(content.sequence, record, now_ns, stamp_ns)
                if record.status == STATUS_OK and record.range_m >= 0:
                    self._arrivals.append((session, arrival))
                else:
                    cause = codes.exchange_cause(record.status) if record.status else "no distance"
                    self._counts[cause.replace(" ", "_")] += 1
                    self.failures[cause] += 1
                session.matcher.add_range(arrival, damages, now_ns)
        elif content is not None:
            emitters = {frame.emitter for frame in content.frames if frame.received}
            if session is None or emitters & (set(self._ranging.settings.peers) - {session.peer}):
                self._counts["unknown_session"] += 1
            else:
                session.matcher.add_diagnostics(content, damages, now_ns)

    def measurements(self, now_ns: int) -> list[RangeMeasurement]:
        """Return the measurements that wait for nothing; later ones wait for earlier ones."""
        for session in self._ranging.sessions:
            session.matcher.expire(now_ns)
        timeout_ns = 2 * max(2_000_000 * self._ranging.settings.effective_interval_ms, MIN_TIMEOUT_NS)
        measurements = []
        while self._arrivals:
            session, arrival = self._arrivals[0]
            if not arrival.is_complete and now_ns - arrival.arrived_ns <= timeout_ns:
                break
            self._arrivals.popleft()
            measurements.append(self._measurement(session.peer, arrival))
        return measurements

    def _measurement(self, peer: int, arrival: RangeArrival) -> RangeMeasurement:
        s, record = self._ranging.settings, arrival.record
        tag, anchor = (s.address, peer) if s.role is Role.TAG else (peer, s.address)
        report = read_cir(arrival.diagnostics, s.channel, record.rssi_dbm, self.position_unit)
        if not math.isnan(report.clock_offset_ppm):
            self.clock_offsets_ppm.append(report.clock_offset_ppm)
        self._counts["ranges"] += 1
        self._counts["without_cir"] += not len(report.cir)
        self._counts["inconsistent_cir"] += not report.consistent
        return RangeMeasurement(
            arrival.stamp_ns, tag, anchor, arrival.sequence, 0, record.range_m, report.cir
        )
