"""The structures of `uwb_dw1000.h` and `uwb_twr.h` for ctypes; a test compares their sizes with the compiler's."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_int, c_size_t, c_uint8, c_uint16, c_uint32, c_uint64, c_void_p
from dataclasses import asdict

from uwb_mitigation.radios.settings import MAX_ANCHORS, RadioSettings

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


def _fields(**names: type) -> tuple[tuple[str, type], ...]:
    return tuple(names.items())


def _same_type(kind: type, names: str) -> dict[str, type]:
    """Return fields of one type, {name: type}."""
    return dict.fromkeys(names.split(), kind)


class ChipSettings(ctypes.Structure):
    """`uwb_dw1000_settings`."""

    _fields_ = _fields(
        **_same_type(c_uint8, "channel prf_mhz preamble_code decawave_sfd"),
        **_same_type(c_uint16, "rate_kbps preamble"),
        **_same_type(c_uint32, "tx_power antenna_delay"),
        anchor=c_uint8,
    )


class Config(ctypes.Structure):
    """`uwb_twr_config`."""

    _fields_ = _fields(
        radio=ChipSettings,
        address=c_uint64,
        pan=c_uint16,
        **_same_type(c_uint8, "role report bias_correction anchor_count"),
        window=c_uint16,
        **_same_type(c_uint32, "reply_us timeout_us interval_us"),
        anchors=c_uint64 * MAX_ANCHORS,
    )


class TwrCounts(ctypes.Structure):
    """`uwb_twr_counts`."""

    _fields_ = _fields(
        **_same_type(
            c_uint32, "tried ranged no_answer late timeout damaged implausible broken refused restarts"
        )
    )

    def as_dict(self) -> dict[str, int]:
        """Return {name: count}."""
        return {name: int(getattr(self, name)) for name, *_ in self._fields_}


class TwrAnchor(ctypes.Structure):
    """`uwb_twr_anchor`."""

    _fields_ = _fields(
        **_same_type(c_uint64, "address last_seen_us next_poll_us"),
        **_same_type(c_uint32, "tried ranged answer_us misses"),
        rx_power_dbm=c_float,
    )


DEFAULT_REPLY_US, DEFAULT_TIMEOUT_US = 1500, 6000
"""Default times for the SPI of a microcontroller, as in `uwb_twr_defaults`."""


def config(
    settings: RadioSettings, reply_us: int = DEFAULT_REPLY_US, timeout_us: int = DEFAULT_TIMEOUT_US
) -> Config:
    """Return the settings as the firmware's structure; the given times replace times of 0.

    Raises:
        ParameterError: a setting is invalid.
    """
    settings.check()
    values = asdict(settings)
    anchors = values.pop("anchors")
    radio = {name: values.pop(name) for name, *_ in ChipSettings._fields_ if name in values}
    values["reply_us"] = settings.reply_us or reply_us
    values["timeout_us"] = settings.timeout_us or timeout_us
    return Config(
        radio=ChipSettings(**radio),
        anchor_count=len(anchors),
        anchors=(c_uint64 * MAX_ANCHORS)(*anchors),
        **values,
    )
