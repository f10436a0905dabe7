"""What a radio is and how it fares, in words: of radios at this computer and of those on boards."""

from __future__ import annotations

from dataclasses import fields

from uwb_mitigation.errors import format_id
from uwb_mitigation.link.layout import RadioState, Role
from uwb_mitigation.link.radio import NEVER_MS, RadioSettings, RadioStatus

COUNTS = tuple(row.name for row in fields(RadioStatus) if row.type == "int")
"""Of the exchanges of a radio, by how they ended."""

_STATES = {
    RadioState.ABSENT: "no DW1000 answers the board: check wiring and supply",
    RadioState.BUS: "the board's SPI fails",
    RadioState.NO_CLOCK: "the DW1000's clock PLL does not lock: check its supply",
}


def told(settings: RadioSettings) -> str:
    """In a line of the log."""
    return (
        f"{settings.role.name.lower()}, channel {settings.channel}, {settings.rate_kbps} kbit/s, preamble "
        f"{settings.preamble}, PAN 0x{settings.pan:04x}"
    )


def problem(status: RadioStatus) -> str:
    """What keeps a board's radio from ranging; empty while nothing does."""
    return _STATES.get(status.state, "")


def warning(settings: RadioSettings | None, status: RadioStatus) -> str:
    """Return what may keep a radio without a problem from ranging; empty if there is nothing."""
    if status.state is RadioState.LOCK_UNCONFIRMED:
        return "the DW1000 has not reported that its clock PLL locked; if it does not range, check its supply"
    if settings is not None and settings.role is Role.TAG and not status.anchors:
        return "no anchor in reach: are they on, with the same channel, rate and PAN?"
    return ""


def facts(settings: RadioSettings | None, status: RadioStatus, prefix: str = "") -> dict[str, object]:
    """For diagnostics, but for the anchors in reach."""
    said: dict[str, object] = {}
    if settings is not None:
        said |= {
            f"{prefix}address": format_id(settings.address),
            f"{prefix}role": settings.role.name.lower(),
            f"{prefix}antenna delay": settings.antenna_delay,
        }
    said |= {f"{prefix}{name.replace('_', ' ')}": getattr(status, name) for name in COUNTS}
    return said | {
        f"{prefix}temperature C": f"{status.temperature_c:.1f}",
        f"{prefix}voltage V": f"{status.voltage:.2f}",
    }


def anchors(status: RadioStatus) -> dict[str, object]:
    """Those in reach, for diagnostics."""
    said: dict[str, object] = {}
    for anchor in status.anchors:
        heard = "never" if anchor.heard_ms == NEVER_MS else f"{anchor.heard_ms / 1000:.1f} s ago"
        said[f"anchor {format_id(anchor.address)}"] = (
            f"{anchor.ranged} of {anchor.tried} ranged, {anchor.rx_power_dbm:.1f} dBm, heard {heard}"
        )
    return said
