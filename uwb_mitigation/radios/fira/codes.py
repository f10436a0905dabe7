"""Numbers of the UCI protocol and their texts: statuses, reasons, parameters, failed exchanges.

Sources: FiRa UCI, as implemented by public hosts; the parameters of Qorvo's firmware (0xE8, 0xE9).
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


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


@dataclass(frozen=True, slots=True)
class ExchangeCause:
    """Why an exchange has no range.

    Attributes:
        name: in words.
        remedy: what to do.
        unexpected: it does not occur because a board is out of range.
    """

    name: str
    remedy: str
    unexpected: bool = False


EXCHANGE_CAUSES = {
    0x1B: ExchangeCause(
        "negative distance", "the boards are closer than 1 m, or their antenna delay is not calibrated", True
    ),
    0x20: ExchangeCause(
        "transmission failed", "load the calibration of the board again, as after a chip erase", True
    ),
    0x21: ExchangeCause(
        "reception timeout",
        "are the other boards on, with the same channel, addresses, session id and interval?",
    ),
    0x22: ExchangeCause("PHY decoding error", "the signal is weak, or other radios use the channel"),
    0x23: ExchangeCause("no time of arrival", "the signal is weak, or other radios use the channel"),
    0x24: ExchangeCause("STS error", "the boards need the same STS and preamble code; or the signal is weak"),
}
"""{status of a range: cause}."""


def exchange_cause(status: int) -> str:
    """Return the cause of a failed exchange in words."""
    cause = EXCHANGE_CAUSES.get(status)
    return cause.name if cause is not None else f"status 0x{status:02x}"


_STATUSES = {
    0x01: "rejected",
    0x02: "failed",
    0x03: "syntax error",
    0x04: "invalid parameter",
    0x05: "value out of range",
    0x06: "invalid message size",
    0x07: "unknown group",
    0x08: "unknown command",
    0x09: "read-only parameter",
    0x0A: "to be repeated",
    0x11: "the session does not exist",
    0x12: "the session exists already",
    0x13: "the session is active",
    0x14: "too many sessions",
    0x15: "the session is not configured: a parameter is missing",
    0x16: "other sessions are active",
}

_REASONS = {
    0x00: "a command of the host",
    0x01: "maximum number of unanswered rounds",
    0x02: "maximum number of measurements",
    0x03: "suspended by the other board",
    0x04: "resumed by the other board",
    0x05: "stopped by the other board",
    0x1D: "invalid UL-TDoA random window",
    0x1E: "too few frames per round",
    0x1F: "unsupported transmit delay or frame interval",
    0x20: "unsupported slot length",
    0x21: "too few slots per round",
    0x22: "unsupported address mode",
    0x23: "invalid ranging interval",
    0x24: "invalid STS configuration",
    0x25: "invalid frame configuration",
    0x26: "hybrid: too few slots",
    0x27: "hybrid: contention-free phase too short",
    0x28: "hybrid: contention access phase too short",
    0x29: "hybrid: other error",
    0x2A: "session key not found",
    0x2B: "sub-session key not found",
    0x2C: "invalid preamble code",
    0x2D: "invalid SFD",
    0x2E: "invalid PSDU data rate",
    0x2F: "invalid PHR data rate",
    0x30: "invalid preamble duration",
    0x31: "invalid STS length",
    0x32: "invalid number of STS segments",
    0x33: "invalid number of controlees",
    0x34: "reply time exceeded",
    0x35: "invalid list of destination addresses",
    0x36: "sub-session not found",
    0x37: "invalid result report",
    0x38: "invalid round control",
    0x39: "invalid round usage",
    0x3A: "invalid multi-node mode",
    0x3B: "secure element not readable",
    0x3C: "reference session does not exist",
    0x3D: "reference session with another interval",
    0x3E: "reference session with an invalid offset",
    0x3F: "reference session lost",
    0x40: "DT-anchor: rounds not configured",
    0x41: "DT-tag: rounds not configured",
    0x42: "initiation time has passed",
    0xA1: "vendor: ranging key expired",
    0xA2: "vendor: maximum STS index",
}

PARAMETERS = {
    0x00: "DEVICE_TYPE",
    0x01: "RANGING_ROUND_USAGE",
    0x02: "STS_CONFIG",
    0x03: "MULTI_NODE_MODE",
    0x04: "CHANNEL_NUMBER",
    0x05: "NUMBER_OF_CONTROLEES",
    0x06: "DEVICE_MAC_ADDRESS",
    0x07: "DST_MAC_ADDRESS",
    0x08: "SLOT_DURATION",
    0x09: "RANGING_INTERVAL",
    0x0D: "AOA_RESULT_REQ",
    0x11: "DEVICE_ROLE",
    0x12: "RFRAME_CONFIG",
    0x13: "RSSI_REPORTING",
    0x14: "PREAMBLE_CODE_INDEX",
    0x15: "SFD_ID",
    0x1B: "SLOTS_PER_RR",
    0x22: "SCHEDULED_MODE",
    0x24: "KEY_ROTATION_RATE",
    0x27: "VENDOR_ID",
    0x28: "STATIC_STS_IV",
    0x2B: "UWB_INITIATION_TIME",
    0x2C: "HOPPING_MODE",
    0x2D: "BLOCK_STRIDE_LENGTH",
    0x2E: "RESULT_REPORT_CONFIG",
    0x32: "MAX_NUMBER_OF_MEASUREMENTS",
    0x35: "STS_LENGTH",
    0xE8: "ENABLE_DIAGNOSTICS",
    0xE9: "DIAGS_FRAME_REPORTS_FIELDS",
}
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
