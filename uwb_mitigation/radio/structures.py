"""The structures of `uwb_dw1000.h` and `uwb_twr.h` for ctypes; a test holds their sizes to the compiler's."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_int, c_size_t, c_uint8, c_uint16, c_uint32, c_uint64, c_void_p

from uwb_mitigation.link.layout import MAX_ANCHORS
from uwb_mitigation.link.radio import RadioSettings

TRANSFER = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p, c_size_t, c_void_p, c_void_p, c_size_t)
SPEED = ctypes.CFUNCTYPE(None, c_void_p, c_int)
RESET = ctypes.CFUNCTYPE(None, c_void_p)
NOW = ctypes.CFUNCTYPE(c_uint64, c_void_p)
WAIT = ctypes.CFUNCTYPE(None, c_void_p, c_uint64)
SLEEP = ctypes.CFUNCTYPE(None, c_void_p, c_uint32)


class Io(ctypes.Structure):
    """`uwb_dw1000_io`."""

    _fields_ = (
        ("context", c_void_p),
        ("transfer", TRANSFER),
        ("speed", SPEED),
        ("reset", RESET),
        ("now_us", NOW),
        ("wait", WAIT),
        ("sleep", SLEEP),
    )


class ChipSettings(ctypes.Structure):
    """`uwb_dw1000_settings`."""

    _fields_ = (
        ("channel", c_uint8),
        ("prf_mhz", c_uint8),
        ("preamble_code", c_uint8),
        ("decawave_sfd", c_uint8),
        ("rate_kbps", c_uint16),
        ("preamble", c_uint16),
        ("tx_power", c_uint32),
        ("antenna_delay", c_uint32),
        ("anchor", c_uint8),
    )


class Config(ctypes.Structure):
    """`uwb_twr_config`."""

    _fields_ = (
        ("radio", ChipSettings),
        ("address", c_uint64),
        ("pan", c_uint16),
        ("role", c_uint8),
        ("report", c_uint8),
        ("bias_correction", c_uint8),
        ("anchor_count", c_uint8),
        ("window", c_uint16),
        ("reply_us", c_uint32),
        ("patience_us", c_uint32),
        ("interval_us", c_uint32),
        ("anchors", c_uint64 * MAX_ANCHORS),
    )


class TwrCounts(ctypes.Structure):
    """`uwb_twr_counts`."""

    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            "tried",
            "ranged",
            "no_answer",
            "late",
            "time_out",
            "damaged",
            "absurd",
            "broken",
            "refused",
            "restarts",
        )
    )

    def as_dict(self) -> dict[str, int]:
        """{name: count}."""
        return {name: int(getattr(self, name)) for name, *_ in self._fields_}


class TwrAnchor(ctypes.Structure):
    """`uwb_twr_anchor`."""

    _fields_ = (
        ("address", c_uint64),
        ("heard_us", c_uint64),
        ("due_us", c_uint64),
        ("tried", c_uint32),
        ("ranged", c_uint32),
        ("answer_us", c_uint32),
        ("misses", c_uint32),
        ("rx_power_dbm", c_float),
    )


USUAL_REPLY_US, USUAL_PATIENCE_US = 1500, 6000
"""For SPI of a microcontroller; those of `uwb_twr_defaults`."""


def config(
    settings: RadioSettings, reply_us: int = USUAL_REPLY_US, patience_us: int = USUAL_PATIENCE_US
) -> Config:
    """The settings as the firmware takes them, with these times where they leave them open; 0 = still open.

    Raises:
        ParameterError: a setting that no radio has.
    """
    settings.check()
    radio = ChipSettings(
        settings.channel,
        settings.prf_mhz,
        settings.preamble_code,
        settings.decawave_sfd,
        settings.rate_kbps,
        settings.preamble,
        settings.tx_power,
        settings.antenna_delay,
    )
    return Config(
        radio,
        settings.address,
        settings.pan,
        settings.role,
        settings.report,
        settings.bias_correction,
        len(settings.anchors),
        settings.window,
        settings.reply_us or reply_us,
        settings.patience_us or patience_us,
        settings.interval_us,
        (c_uint64 * MAX_ANCHORS)(*settings.anchors),
    )
