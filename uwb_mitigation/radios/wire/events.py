"""States, events and counts of a `BoardSession`."""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass, field

from uwb_mitigation.radios.settings import RadioStatus
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Hello, Log, RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement


class LinkState(enum.Enum):
    """State of the session."""

    CONNECTING = "waiting for the board's HELLO"
    READY = "connected"
    WRONG_VERSION = "the board uses another protocol version"


class Loss(enum.Enum):
    """Why a connection ended."""

    TIMEOUT = "no intact frame was received for 3 s"
    RESET = "the board restarted"
    OUT_OF_SEQUENCE = "the sequence numbers of the board are out of order"
    CLOSED = "the port was closed"


@dataclass(frozen=True, slots=True)
class Connected:
    """The board has sent its HELLO; measurements follow."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The connection was lost. No data is delivered until the next `Connected`."""

    loss: Loss


@dataclass(frozen=True, slots=True)
class VersionMismatch:
    """The board uses another protocol version; its data is not delivered."""

    version: int


@dataclass(frozen=True, slots=True)
class ModeChanged:
    """The board has confirmed the requested mode."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class ModeRefused:
    """The board was requested to use the mode `requested` but stays in `mode`."""

    requested: Mode
    mode: Mode


@dataclass(frozen=True, slots=True)
class RadioRefused:
    """The board does not use the requested radio settings; `text` is the reason."""

    text: str


@dataclass(frozen=True, slots=True)
class OffsetsRefused:
    """The board does not use the requested offsets; `text` is the reason. Its corrections are not delivered."""

    text: str


Event = (
    Connected
    | Disconnected
    | VersionMismatch
    | ModeChanged
    | ModeRefused
    | RangeMeasurement
    | Correction
    | Log
    | BoardStatus
    | RadioConfigured
    | RadioStatus
    | RadioRefused
    | OffsetsRefused
)


@dataclass(slots=True)
class SessionCounts:
    """Counts of intact frames that were not delivered, and of lost frames.

    Attributes:
        lost: missing sequence numbers.
        stale: sequence number not above that of a frame already received.
        withheld: received while not connected.
        unknown_type: of types unknown to this version, {type: count}.
        malformed: of a known type, but with invalid contents.
        wrong_model: corrections by another model than the expected one.
        wrong_offsets: corrections before the board confirmed the requested offsets.
        unsolicited: unsolicited answers.
        unsent: requests dropped because the output queue was full.
        connections: HELLOs that started a connection.
    """

    lost: int = 0
    stale: int = 0
    withheld: int = 0
    unknown_type: Counter[int] = field(default_factory=Counter)
    malformed: int = 0
    wrong_model: int = 0
    wrong_offsets: int = 0
    unsolicited: int = 0
    unsent: int = 0
    connections: int = 0
