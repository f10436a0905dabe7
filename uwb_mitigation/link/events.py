"""What a `BoardSession` tells its owner: states, events, counts."""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass, field

from uwb_mitigation.link.layout import Mode
from uwb_mitigation.link.messages import BoardStatus, Correction, Hello, Log, Radio
from uwb_mitigation.link.radio import RadioStatus
from uwb_mitigation.measurement import RangeMeasurement


class LinkState(enum.Enum):
    """Where the session stands."""

    CONNECTING = "waiting for the board's HELLO"
    READY = "connected"
    WRONG_VERSION = "the board speaks another version of the protocol"


class Loss(enum.Enum):
    """Why a connection ended."""

    SILENT = "nothing intact was received for 3 s"
    RESET = "the board started anew"
    OUT_OF_STEP = "the board's frames are numbered out of order"
    CLOSED = "the port was closed"


@dataclass(frozen=True, slots=True)
class Connected:
    """The board has introduced itself; measurements follow."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class Disconnected:
    """Nothing is delivered until the next `Connected`."""

    loss: Loss


@dataclass(frozen=True, slots=True)
class VersionMismatch:
    """The board speaks another version of the protocol: nothing of it is delivered."""

    version: int


@dataclass(frozen=True, slots=True)
class ModeChanged:
    """The board has confirmed the mode that was asked for."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class ModeRefused:
    """The board answered a request for `wanted` by staying in `mode`."""

    wanted: Mode
    mode: Mode


@dataclass(frozen=True, slots=True)
class RadioRefused:
    """The board does not use the settings of the radio that were asked for; `text` says why."""

    text: str


@dataclass(frozen=True, slots=True)
class OffsetsRefused:
    """The board does not use the offsets that were asked for; `text` says why. Its corrections are not delivered."""

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
    | Radio
    | RadioStatus
    | RadioRefused
    | OffsetsRefused
)


@dataclass(slots=True)
class SessionCounts:
    """Frames that arrived intact and were not delivered, and frames that did not arrive.

    Attributes:
        lost: missing in the board's numbering.
        stale: numbered at or before one that was already received.
        withheld: while not connected.
        unknown_type: of types that this version does not know, {type: count}.
        malformed: of a known type, but with impossible contents.
        wrong_model: corrections by another model than the expected one.
        wrong_offsets: corrections that are not known to hold the offsets asked for.
        unasked: answers to nothing that was asked.
        unsent: requests dropped because what is to be sent piled up.
        connections: HELLOs that began a connection.
    """

    lost: int = 0
    stale: int = 0
    withheld: int = 0
    unknown_type: Counter[int] = field(default_factory=Counter)
    malformed: int = 0
    wrong_model: int = 0
    wrong_offsets: int = 0
    unasked: int = 0
    unsent: int = 0
    connections: int = 0
