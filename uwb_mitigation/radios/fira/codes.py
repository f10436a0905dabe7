"""Numbers of the UCI protocol and their texts: statuses, reasons, parameters, failed exchanges.

Sources: FiRa UCI, as implemented by public hosts; the parameters of Qorvo's firmware (0xE8, 0xE9).
"""

from __future__ import annotations

import enum


class PacketType(enum.IntEnum):
    """Message type (MT) of a packet."""

    COMMAND = 1
    RESPONSE = 2
    NOTIFICATION = 3


class GroupId(enum.IntEnum):
    """Group identifier (GID) of a packet."""

    CORE = 0x0
    SESSION = 0x1
    RANGING = 0x2
    VENDOR = 0xB
    CALIBRATION = 0xE


RESET = (GroupId.CORE, 0)
DEVICE_STATUS = (GroupId.CORE, 1)
DEVICE_INFO = (GroupId.CORE, 2)
GENERIC_ERROR = (GroupId.CORE, 7)
SESSION_INIT = (GroupId.SESSION, 0)
SESSION_DEINIT = (GroupId.SESSION, 1)
SESSION_STATUS = (GroupId.SESSION, 2)
SET_APP_CONFIG = (GroupId.SESSION, 3)
GET_SESSION_STATE = (GroupId.SESSION, 6)
RANGE_START = (GroupId.RANGING, 0)
"""The command that starts a session; the notification of this number contains ranges."""
RANGE_STOP = (GroupId.RANGING, 1)
RANGE_DIAGNOSTICS = (GroupId.VENDOR, 3)
BOOT = (GroupId.VENDOR, 0x31)
SET_CALIBRATION = (GroupId.CALIBRATION, 0x2A)
GET_CALIBRATION = (GroupId.CALIBRATION, 0x2B)

STATUS_OK = 0
DEVICE_READY = 1


class SessionState(enum.IntEnum):
    """State of a session in `SESSION_STATUS`."""

    INIT = 0
    DEINIT = 1
    ACTIVE = 2
    IDLE = 3


_EXCHANGES = {
    0x1B: ("negative distance", "the boards are closer than 1 m, or their antenna delay is not calibrated"),
    0x20: ("transmission failed", "load the calibration of the board again, as after a chip erase"),
    0x21: ("reception timeout", "are the other boards on, with the same channel, addresses, session id and interval?"),
    0x22: ("PHY decoding error", "the signal is weak, or other radios use the channel"),
    0x23: ("no time of arrival", "the signal is weak, or other radios use the channel"),
    0x24: ("STS error", "the boards need the same STS and preamble code; or the signal is weak"),
}  # fmt: skip
EXCHANGE_REMEDIES = dict(_EXCHANGES.values())
"""{cause of an exchange without a range: what to do}."""

UNEXPECTED_CAUSES = ("negative distance", "transmission failed")
"""Causes that do not occur because a board is out of range."""


def exchange_cause(status: int) -> str:
    """Return the cause of a failed exchange in words."""
    return _EXCHANGES.get(status, (f"status 0x{status:02x}", ""))[0]


_STATUS_TEXTS = (
    "rejected; failed; syntax error; invalid parameter; value out of range; invalid message size; unknown group; "
    "unknown command; read-only parameter; to be repeated; the session does not exist; the session exists already; "
    "the session is active; too many sessions; the session is not configured: a parameter is missing; "
    "other sessions are active"
)
_STATUSES = dict(zip((*range(0x01, 0x0B), *range(0x11, 0x17)), _STATUS_TEXTS.split("; "), strict=True))

_REASONS = {
    0x01: "maximum number of unanswered rounds",
    0x02: "maximum number of measurements",
    0xA1: "vendor: ranging key expired",
    0xA2: "vendor: maximum STS index",
}
_REASON_TEXTS = (
    "a command of the host; suspended by the other board; resumed by the other board; stopped by the other board; "
    "invalid UL-TDoA random window; too few frames per round; unsupported transmit delay; unsupported slot length; "
    "too few slots per round; unsupported address mode; invalid ranging interval; invalid STS configuration; "
    "invalid frame configuration; hybrid: too few slots; hybrid: contention-free phase too short; "
    "hybrid: contention access phase too short; hybrid: other error; session key not found; "
    "sub-session key not found; invalid preamble code; invalid SFD; invalid PSDU data rate; invalid PHR data rate; "
    "invalid preamble duration; invalid STS length; invalid number of STS segments; invalid number of controlees; "
    "reply time exceeded; invalid list of destination addresses; sub-session not found; invalid result report; "
    "invalid round control; invalid round usage; invalid multi-node mode; secure element not readable; "
    "reference session does not exist; reference session with another interval; "
    "reference session with an invalid offset; reference session lost; DT-anchor: rounds not configured; "
    "DT-tag: rounds not configured; initiation time has passed"
)
_REASON_NUMBERS = (0x00, *range(0x03, 0x06), *range(0x1D, 0x43))
_REASONS |= dict(zip(_REASON_NUMBERS, _REASON_TEXTS.split("; "), strict=True))

_PARAMETER_NAMES = (
    "DEVICE_TYPE RANGING_ROUND_USAGE STS_CONFIG MULTI_NODE_MODE CHANNEL_NUMBER NUMBER_OF_CONTROLEES "
    "DEVICE_MAC_ADDRESS DST_MAC_ADDRESS SLOT_DURATION RANGING_INTERVAL AOA_RESULT_REQ DEVICE_ROLE RFRAME_CONFIG "
    "RSSI_REPORTING PREAMBLE_CODE_INDEX SFD_ID SLOTS_PER_RR SCHEDULED_MODE KEY_ROTATION_RATE VENDOR_ID "
    "STATIC_STS_IV UWB_INITIATION_TIME HOPPING_MODE BLOCK_STRIDE_LENGTH RESULT_REPORT_CONFIG "
    "MAX_NUMBER_OF_MEASUREMENTS STS_LENGTH ENABLE_DIAGNOSTICS DIAGS_FRAME_REPORTS_FIELDS"
)
_TAGS = bytes.fromhex(
    "00 01 02 03 04 05 06 07 08 09 0d 11 12 13 14 15 1b 22 24 27 28 2b 2c 2d 2e 32 35 e8 e9"
)
PARAMETERS = dict(zip(_TAGS, _PARAMETER_NAMES.split(), strict=True))
"""{tag: name} of the parameters of a session."""


def parameter_name(tag: int) -> str:
    """Return the name and the tag of a parameter."""
    return f"{PARAMETERS[tag]} (0x{tag:02x})" if tag in PARAMETERS else f"0x{tag:02x}"


def status_text(status: int) -> str:
    """Return the status of a response in words, with its number."""
    return f"{_STATUSES.get(status, 'unknown')} (status 0x{status:02x})"


def reason_text(reason: int) -> str:
    """Return the reason for a change of a session in words, with its number."""
    unknown = "a reason of the manufacturer" if reason >= 0x80 else "an unknown reason"
    return f"{_REASONS.get(reason, unknown)} (reason 0x{reason:02x})"
