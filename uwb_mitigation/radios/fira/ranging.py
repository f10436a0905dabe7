"""The ranging sessions of a UCI board, one for each peer: opening, parameters, states. No I/O."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

from uwb_mitigation.radios.fira import codes, messages
from uwb_mitigation.radios.fira.codes import STATUS_OK, SessionState
from uwb_mitigation.radios.fira.commands import Command, Steps
from uwb_mitigation.radios.fira.joining import DiagnosticsMatcher
from uwb_mitigation.radios.fira.packets import Packet
from uwb_mitigation.radios.fira.settings import UciSettings

STOP_NS = 100_000_000
"""Timeout of a command at the end."""

_NEEDED = frozenset((0x00, 0x06, 0x07, 0x11))
"""Parameters without which a session cannot range: role and addresses."""


@dataclass(slots=True, eq=False)
class PeerSession:
    """A session with one peer.

    Attributes:
        peer: address of the peer.
        handle, number: its numbers on the board, and at both ends.
        matcher: joins its ranges with their diagnostics.
        active: the board has reported that it ranges.
        ended: why it has ended by itself; empty = it has not.
    """

    peer: int
    handle: int
    number: int
    matcher: DiagnosticsMatcher
    active: bool = False
    ended: str = ""

    @property
    def packed(self) -> bytes:
        return struct.pack("<I", self.handle)


class Ranging:
    """Opens and closes the sessions of a board.

    Args:
        settings: what the board does.

    Attributes:
        settings: see above.
        sessions: the sessions that are open, or were ended by the board.
        rejected: parameters that the board did not accept, {tag: status}.
    """

    def __init__(self, settings: UciSettings) -> None:
        self.settings = settings
        self.sessions: list[PeerSession] = []
        self.rejected: dict[int, int] = {}
        self._earlier = Counter(DiagnosticsMatcher(0).counts)

    def totals(self) -> Counter[str]:
        """Return the numbers of joined and other ranges."""
        total = Counter(self._earlier)
        for session in self.sessions:
            total.update(session.matcher.counts)
        return total

    def forget(self) -> None:
        """Forget all sessions, whose board was lost or reset."""
        self._earlier, self.sessions = self.totals(), []

    def find(self, number: int) -> PeerSession | None:
        """Return the session with a handle, or with a number, which some boards put into notifications."""
        matching = [s for s in self.sessions if number in (s.handle, s.number)]
        return min(matching, key=lambda session: session.handle != number, default=None)

    def follow(self, packet: Packet) -> None:
        """Note the state of a session in a notification."""
        if len(packet.payload) < 5:
            return
        number, state = struct.unpack_from("<IB", packet.payload)
        session = self.find(number)
        if session is None:
            return
        if state == SessionState.ACTIVE:
            session.active = True
        elif session.active:
            session.active = False
            reason = codes.reason_text(packet.payload[5] if len(packet.payload) > 5 else 0)
            session.ended = f"the board has ended the session with {session.peer}: {reason}"

    @property
    def ended(self) -> list[PeerSession]:
        """The sessions that the board has ended."""
        return [session for session in self.sessions if session.ended]

    def open_all(self) -> Steps:
        """Open a session with each peer."""
        self.rejected = {}
        for peer in self.settings.peers:
            if problem := (yield from self._open(peer)):
                return problem
        return ""

    def open_again(self) -> Steps:
        """Open sessions again that have ended, without a reset of the board and its other sessions."""
        for session in self.ended:
            yield Command(codes.SESSION_DEINIT, session.packed, tries=1)
            self.sessions.remove(session)
            self._earlier.update(session.matcher.counts)
            if problem := (yield from self._open(session.peer)):
                return problem
        return ""

    def close_all(self) -> Steps:
        """Close all sessions."""
        for session in self.sessions:
            for name in (codes.RANGE_STOP, codes.SESSION_DEINIT):
                yield Command(name, session.packed, tries=1, timeout_ns=STOP_NS)
        return ""

    def _open(self, peer: int) -> Steps:
        session_id = self.settings.session_id(peer)
        number = struct.pack("<I", session_id)
        answer = yield Command(codes.SESSION_INIT, number + b"\0")
        if answer is not None and answer.status != STATUS_OK:
            # The session may exist from before, on a board that has refused the reset.
            yield Command(codes.SESSION_DEINIT, number, tries=1)
            answer = yield Command(codes.SESSION_INIT, number + b"\0")
        if answer is None or answer.status != STATUS_OK:
            # It does not depend on the parameters of other sessions.
            return _refused("SESSION_INIT", answer)
        # FiRa 1.3 firmware answers without a handle: it uses the session's number.
        (handle,) = struct.unpack("<I", answer.payload[1:5] if len(answer.payload) >= 5 else number)
        if problem := (yield from self._configure(handle, self.settings.app_config(peer))):
            return problem
        # The first range may arrive before the answer to the start.
        matcher = DiagnosticsMatcher(self.settings.effective_interval_ms * 1_000_000)
        session = PeerSession(peer, handle, session_id, matcher)
        self.sessions.append(session)
        answer = yield Command(codes.RANGE_START, session.packed)
        # The answer may be lost, and a repeated start is refused.
        if session.ended or session.active:
            return ""
        if answer is None or answer.status != STATUS_OK:
            return _refused("RANGE_START", answer, self.rejected_text)
        # The notification of the active state may be lost.
        session.active = True
        return ""

    def _configure(self, handle: int, entries: list[tuple[int, bytes]]) -> Steps:
        """Set the parameters of a session without those that the board rejects: firmware versions differ."""
        waiting, repeats = [entries], 1
        while waiting:
            packet = waiting.pop(0)
            answer = yield Command(codes.SET_APP_CONFIG, messages.app_config(handle, packet))
            if answer is None:
                return _refused("SET_APP_CONFIG", answer)
            named = messages.rejected_tags(answer.payload)
            rejected = {tag: named[tag] for tag, _ in packet if tag in named}
            failed = answer.status != STATUS_OK
            if failed and not rejected and repeats:
                repeats -= 1
                waiting.insert(0, packet)
                continue
            if failed and not rejected and len(packet) == 1:
                rejected = {packet[0][0]: answer.status}
            self.rejected |= rejected
            if _NEEDED & rejected.keys():
                return _refused("SET_APP_CONFIG", answer, self.rejected_text)
            accepted = [entry for entry in packet if entry[0] not in rejected]
            if failed and accepted:
                # An answer that names no parameter: set each one with its own command.
                waiting = [accepted] if rejected else [[entry] for entry in accepted]
        return ""

    @property
    def rejected_text(self) -> str:
        """The parameters that the board did not accept, with their statuses; empty: none."""
        rejected = sorted(self.rejected.items())
        return "; ".join(
            f"{codes.parameter_name(tag)}: {codes.status_text(status)}" for tag, status in rejected
        )


def _refused(command: str, answer: Packet | None, rejected: str = "") -> str:
    """Return a problem, with the parameters that the board has rejected: one of them may be the cause."""
    names = f"; it rejects {rejected}" if rejected else ""
    if answer is None:
        return f"the board does not answer {command}{names}"
    return f"the board refuses {command}: {codes.status_text(answer.status)}{names}"
