"""States, events and counts of a `BoardSession`."""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass

RADIO_PROBLEM = "the radio's settings are not used"
OFFSETS_PROBLEM = "the offsets are not set, so the corrections of the board are not published"


class LinkState(enum.Enum):
    """State of the session."""

    CONNECTING = "waiting for the board's HELLO"
    READY = "connected"
    WRONG_VERSION = "the board uses another protocol version"


class Loss(enum.Enum):
    """Event: why a connection ended. No data is delivered until the next `Hello`."""

    TIMEOUT = "no intact frame was received for 3 s"
    RESET = "the board restarted"
    OUT_OF_SEQUENCE = "the sequence numbers of the board are out of order"
    CLOSED = "the port was closed"


@dataclass(frozen=True, slots=True)
class Refused:
    """The board does not use the requested settings or offsets; without the offsets, its corrections are not delivered.

    Attributes:
        problem: `RADIO_PROBLEM` or `OFFSETS_PROBLEM`.
        text: the reason.
    """

    problem: str
    text: str


Event = object
"""A `Hello` when a connection begins, a `Loss` when it ends, `Refused`, a `RangeMeasurement`, another message of the board, or a
`PortMessage`."""

COUNTS = Counter(
    # missing sequence numbers
    lost=0,
    # sequence number not above that of a frame already received
    stale=0,
    # received while not connected
    withheld=0,
    # of types unknown to this version
    unknown_type=0,
    # of a known type, but with invalid contents
    malformed=0,
    # corrections by another model than the expected one
    wrong_model=0,
    # corrections before the board confirmed the requested offsets
    wrong_offsets=0,
    # unsolicited answers
    unsolicited=0,
    # requests dropped because the output queue was full
    unsent=0,
    # HELLOs that started a connection
    connections=0,
)
"""Counts of intact frames that were not delivered, and of lost frames, at the start."""
