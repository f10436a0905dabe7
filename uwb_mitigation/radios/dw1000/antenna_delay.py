"""Calibration of the antenna delay of a pair of radios from LOS ranges at a known distance."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.radios.dw1000.bus import Bus
from uwb_mitigation.radios.dw1000.driver import RadioDriver
from uwb_mitigation.radios.settings import RadioSettings, Role
from uwb_mitigation.types.measurement import DEVICE_TICK_HZ, RangeMeasurement

M_PER_TICK = 0.5 * 299_792_458.0 / DEVICE_TICK_HZ
"""Range error per tick that the total TX + RX antenna delay of one radio is too small: 2.35 mm
(Decawave APS014)."""

MAX_SD_M = 0.1
"""Limit of the standard deviation of a range; that of DW1000s in LOS is 2 to 5 cm."""

MAX_POWER_GAP_DB = 6.0
"""Received minus first-path power below which a link is likely LOS (DW1000 User Manual 2.09, 4.7)."""

NOMINAL_TICKS = 2 * 16436
MAX_FROM_NOMINAL_TICKS = 2000
"""Largest plausible difference from nominal. Radios differ by 100 ticks; a metre of antenna cable adds 600."""

TIMEOUT_S = 30.0
"""Timeout: if no range arrives for this time, the calibration is aborted."""


@dataclass(frozen=True, slots=True)
class AntennaDelay:
    """Result of the calibration.

    Attributes:
        antenna_delay: total TX + RX antenna delay of each calibrated radio, ticks.
        before: antenna delay during the measurement; the mean if two radios are calibrated.
        offset_m: median of the ranges minus the distance.
        sd_m: standard deviation of one range, as half of the central 68 % interval.
        power_gap_db: median of received minus first-path power.
        ranges: number of ranges.
    """

    antenna_delay: int
    before: float
    offset_m: float
    sd_m: float
    power_gap_db: float
    ranges: int


def delay_from_ranges(
    ranges_m: ArrayLike, power_gap_db: ArrayLike, distance_m: float, before: Sequence[int]
) -> AntennaDelay:
    """Return the antenna delay for which the median range equals the distance.

    Args:
        ranges_m: measured ranges, float64 (n,), m, two or more.
        power_gap_db: receive level minus first-path level, float64 (n,), dB; NaN: unknown.
        distance_m: true distance, m.
        before: present delay of each radio to calibrate: of both, which then share the offset, or of one.

    Raises:
        UwbMitigationError: the ranges scatter too much, the link is probably not LOS, or the resulting delay is
            implausible.
    """
    ranges = np.asarray(ranges_m, np.float64)
    low, middle, high = (float(value) for value in np.quantile(ranges, [0.1587, 0.5, 0.8413]))
    spread = (high - low) / 2
    if not spread <= MAX_SD_M:
        raise UwbMitigationError(
            f"the standard deviation of the ranges is {spread:.3f} m",
            valid=f"at most {MAX_SD_M} m: keep the radios and the area between them free of motion and objects",
        )
    gap = float(np.median(np.asarray(power_gap_db, np.float64)))
    if not gap <= MAX_POWER_GAP_DB:
        raise UwbMitigationError(
            f"NLOS: the first path is {gap:.1f} dB below the received power",
            valid=f"at most {MAX_POWER_GAP_DB} dB: place the antennas in line of sight, high above the floor",
        )
    offset = middle - distance_m
    found = round(float(np.mean(before)) + offset / (M_PER_TICK * len(before)))
    if abs(found - NOMINAL_TICKS) > MAX_FROM_NOMINAL_TICKS:
        raise UwbMitigationError(
            f"the range error is {offset:.2f} m: an antenna delay of {found} ticks",
            valid=f"{NOMINAL_TICKS} +- {MAX_FROM_NOMINAL_TICKS}: check the distance and the ports",
        )
    return AntennaDelay(found, float(np.mean(before)), offset, spread, gap, len(ranges))


def measure(
    openers: Sequence[Callable[[], Bus]],
    settings: RadioSettings,
    distance_m: float,
    exchanges: int,
    on_range: Callable[[], None],
) -> AntennaDelay:
    """Range with one anchor until there are enough ranges, then `delay_from_ranges` the delay.

    Args:
        openers: of the tag's bus, and of the anchor's bus if the anchor is at this computer too; otherwise the
            anchor's delay is unchanged and the tag's delay compensates the whole offset.
        settings: settings of the tag.
        distance_m: true distance, m.
        exchanges: number of ranges.
        on_range: called after each range.

    Raises:
        UwbMitigationError: see `delay_from_ranges`; or no anchor answers, or several do.
        ParameterError, MissingDependencyError: see `RadioDriver`.
    """
    settings_of_roles = settings, replace(settings, role=Role.ANCHOR, anchors=())
    with ExitStack() as stack:
        ports = [
            stack.enter_context(closing(RadioDriver(open_bus, radio_settings)))
            for open_bus, radio_settings in zip(openers, settings_of_roles, strict=False)
        ]
        return _measure(ports, distance_m, exchanges, on_range)


def _measure(
    ports: Sequence[RadioDriver], distance_m: float, exchanges: int, on_range: Callable[[], None]
) -> AntennaDelay:
    ranges: list[tuple[float, float]] = []
    anchors: set[int] = set()
    until = time.monotonic() + TIMEOUT_S
    while len(ranges) < exchanges:
        event = ports[0].get(0.2)
        if isinstance(event, RangeMeasurement):
            if len(ports) > 1 and not _has_address(event.anchor_id, ports[1]):
                continue
            anchors.add(event.anchor_id)
            if len(anchors) > 1:
                raise UwbMitigationError(
                    f"anchors {', '.join(f'0x{anchor:016x}' for anchor in sorted(anchors))} answer",
                    valid="one anchor: select it with --anchor",
                )
            ranges.append((event.range_m, event.cir.rx_power_dbm - event.cir.first_path_power_dbm))
            until = time.monotonic() + TIMEOUT_S
            on_range()
        elif time.monotonic() > until:
            problems = [report.problem for report in (port.report() for port in ports) if report.problem]
            raise UwbMitigationError(
                f"only {len(ranges)} of {exchanges} ranges, and no range for {TIMEOUT_S:g} s",
                valid="; ".join(problems) or "an anchor in range with the same channel, PRF, rate and PAN",
            )
    before = [settings.antenna_delay for port in ports if (settings := port.report().settings) is not None]
    if len(before) < len(ports):
        raise UwbMitigationError("a radio was lost at the end of the measurement", valid="try again")
    measured, gaps = zip(*ranges, strict=True)
    return delay_from_ranges(measured, gaps, distance_m, before)


def _has_address(address: int, port: RadioDriver) -> bool:
    settings = port.report().settings
    return settings is not None and settings.address == address
