"""Checks of a field report: what a radio reported during a test, compared with limits. No I/O."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import SATURATED, WINDOW_LEAD
from uwb_mitigation.types.measurement import LINE_OF_SIGHT_DB, CorrectedRange, RangeMeasurement


class Verdict(str, enum.Enum):
    """Result of a check."""

    PASS = "pass"
    WARNING = "warning"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the report.

    Attributes:
        name: what is checked.
        value: measured value with its unit.
        limit: values that pass.
        verdict: result.
        remedy: what to do if it does not pass.
    """

    name: str
    value: str
    limit: str
    verdict: Verdict
    remedy: str = ""


@dataclass(slots=True)
class Observation:
    """What was observed at a pair of radios.

    Attributes:
        distance_m: true distance.
        seconds: duration of the measurement.
        expected_ids: (tag, anchor); None = not known.
        identity: {property: value} that the radio reports.
        written, read: settings or registers that were written, and read back, {name: value}.
        ranges: measurements at the distance.
        corrected: ranges corrected by the model; empty: the model was not trained for the radio.
        has_cirs: whether the radio reports CIRs.
        model: name of the model, and what it was trained for.
        foreign: number of ranges with unexpected addresses.
        damaged: number of damaged packets.
        temperature_c, voltage: NaN = not reported.
        clock_offset_ppm: clock relative to that of the peer; NaN = not reported.
        unplugged: whether the user unplugged the board; None = not tested.
        recovery_s: time from the reopening of the port to the next range; NaN = there was none.
        problem: last problem of the driver; empty = none.
        warnings: all warnings of the driver.
        failures: number of failed exchanges, {cause: count}.
        remedies: {cause: what to do}.
        counters: last diagnostics of the driver, {name: value}.
    """

    distance_m: float
    seconds: float
    expected_ids: tuple[int, int] | None = None
    identity: dict[str, str] = field(default_factory=dict)
    written: dict[str, object] = field(default_factory=dict)
    read: dict[str, object] = field(default_factory=dict)
    ranges: list[RangeMeasurement] = field(default_factory=list)
    corrected: Sequence[CorrectedRange] = ()
    has_cirs: bool = True
    model: str = ""
    foreign: int = 0
    damaged: int = 0
    temperature_c: float = math.nan
    voltage: float = math.nan
    clock_offset_ppm: float = math.nan
    unplugged: bool | None = None
    recovery_s: float = math.nan
    problem: str = ""
    warnings: list[str] = field(default_factory=list)
    failures: Mapping[str, int] = field(default_factory=dict)
    remedies: Mapping[str, str] = field(default_factory=dict)
    counters: Mapping[str, object] = field(default_factory=dict)


def run_checks(o: Observation) -> list[Check]:
    """Return all checks that apply to an observation."""
    rate_hz, remedy = len(o.ranges) / o.seconds, "see the troubleshooting of the board"
    problem = Verdict.FAIL if o.problem else Verdict.PASS
    warning = Verdict.WARNING if o.warnings else Verdict.PASS
    checks = [
        _check("problem of the driver", o.problem or "none", "none", problem, remedy),
        _check("warnings of the driver", "; ".join(o.warnings[:5]) or "none", "none", warning, remedy),
        *_settings(o.written, o.read),
        _judge("ranges per second", rate_hz, 5, 1, "Hz", remedy, low=True),
        _ids(o),
        *_failures(o),
    ]
    if o.ranges:
        checks += [*_ranges(o), *(_cirs(o) if o.has_cirs else ()), *_model(o)]
    damage = o.damaged / max(len(o.ranges), 1)
    checks.append(_judge("damaged packets per range", damage, 0.01, 0.1, "", "use another cable or USB port"))
    if not math.isnan(o.temperature_c):
        checks.append(_judge("temperature", o.temperature_c, 60, 80, "°C", "let the board cool down"))
    if not math.isnan(o.voltage):
        remedy = "supply the radio with 3.3 V; use another cable or a powered hub"
        checks.append(_judge("supply", o.voltage, 3.0, 2.8, "V", remedy, low=True))
    if not math.isnan(o.clock_offset_ppm):
        remedy = "one crystal is out of its limits: check its trim"
        checks.append(_judge("clock error", abs(o.clock_offset_ppm), 25, 40, "ppm", remedy))
    if o.unplugged is not None:
        checks.append(_recovery(o))
    return checks


def _check(name: str, value: str, limit: str, verdict: Verdict, remedy: str) -> Check:
    """Return a check; one that passes needs no remedy."""
    return Check(name, value, limit, verdict, "" if verdict is Verdict.PASS else remedy)


def _failures(o: Observation) -> Iterator[Check]:
    total = sum(o.failures.values()) + len(o.ranges)
    for cause, count in o.failures.items():
        remedy = o.remedies.get(cause, "send this report")
        verdict = _judge("", count / max(total, 1), 0.05, 0.5, "", remedy).verdict
        yield _check(f"failed exchanges: {cause}", f"{count} of {total}", "at most 5 %", verdict, remedy)


def _recovery(o: Observation) -> Check:
    name = "recovery after reconnecting"
    if not o.unplugged:
        return Check(
            name, "not unplugged", "at most 1 s", Verdict.WARNING, "repeat the test and unplug the board"
        )
    if math.isnan(o.recovery_s):
        return Check(name, "not recovered", "at most 1 s", Verdict.FAIL, "send this report")
    return _judge(name, o.recovery_s, 1.0, 5.0, "s", "send this report")


def _judge(
    name: str, value: float, warn: float, fail: float, unit: str, remedy: str, *, low: bool = False
) -> Check:
    """Return a check of a value that must not exceed limits, or with `low` not fall below them."""
    sign = -1 if low else 1
    verdict = Verdict.PASS
    if math.isnan(value) or sign * value > sign * fail:
        verdict = Verdict.FAIL
    elif sign * value > sign * warn:
        verdict = Verdict.WARNING
    bound = "at least" if low else "at most"
    scale = 100 if unit == "%" else 1
    limit = f"{bound} {scale * warn:g} {unit}".rstrip()
    shown = f"{scale * value:.3g} {unit}".rstrip()
    return _check(name, shown, limit, verdict, remedy)


def _settings(written: Mapping[str, object], read: Mapping[str, object]) -> Iterator[Check]:
    for name, value in written.items():
        answer = read.get(name)
        verdict = Verdict.PASS if answer == value else Verdict.WARNING if answer is None else Verdict.FAIL
        shown = "not answered" if answer is None else str(answer)
        remedy = "the radio did not accept the value that was written"
        yield _check(f"read back: {name}", shown, str(value), verdict, remedy)


def _ids(o: Observation) -> Check:
    pairs = sorted({(measured.tag_id, measured.anchor_id) for measured in o.ranges})
    expected = (
        "one pair" if o.expected_ids is None else "tag {}, anchor {}".format(*map(format_id, o.expected_ids))
    )
    good = len(pairs) == 1 and o.expected_ids in (None, pairs[0]) and o.foreign <= len(o.ranges) / 100
    shown = (
        ", ".join(f"tag {format_id(tag)}, anchor {format_id(anchor)}" for tag, anchor in pairs[:5]) or "none"
    )
    if o.foreign:
        shown += f"; {o.foreign} ranges of other addresses"
    remedy = "switch other radios off, and check that the ids are not swapped"
    return _check("ids", shown, expected, Verdict.PASS if good else Verdict.FAIL, remedy)


def _ranges(o: Observation) -> Iterator[Check]:
    ranges_m = np.array([measured.range_m for measured in o.ranges])
    low, middle, high = np.quantile(ranges_m, [0.1587, 0.5, 0.8413])
    remedy = "calibrate the antenna delays (uwb-mitigation offset), and check the distance"
    yield _judge("error of the median range", abs(middle - o.distance_m), 0.15, 0.3, "m", remedy)
    remedy = "keep the area between the antennas free, and away from walls"
    yield _judge("standard deviation of a range", (high - low) / 2, 0.1, 0.2, "m", remedy)
    gaps = [measured.cir.power_gap_db for measured in o.ranges if not math.isnan(measured.cir.power_gap_db)]
    if gaps:
        name, remedy = "receive minus first-path level", "place the antennas in line of sight"
        yield _judge(name, float(np.median(gaps)), LINE_OF_SIGHT_DB, 10, "dB", remedy)
    stamps_s = np.diff([measured.stamp_ns for measured in o.ranges]) / 1e9
    if len(stamps_s):
        pause_s = float(stamps_s.max())
        yield _judge("longest pause between ranges", pause_s, 1.0, 5.0, "s", "check cable and power")
        backwards = int((stamps_s < 0).sum())
        yield _judge("stamps that go backwards", backwards, 0, 0, "", "send this report")


def _cirs(o: Observation) -> Iterator[Check]:
    cirs = [measured.cir for measured in o.ranges]
    filled = [cir for cir in cirs if np.any(cir.samples)]
    remedy = "the firmware reports no CIR, or only zeros: use the image of the hardware page"
    yield _judge("share of ranges with CIR", len(filled) / len(cirs), 0.95, 0.5, "%", remedy, low=True)
    if not filled:
        return
    # A comparison with NaN is false.
    inside = np.mean([0 <= cir.first_path_index - cir.start_index < len(cir) for cir in filled])
    remedy = "send this report"
    yield _judge("share of first paths in the CIR", float(inside), 0.95, 0.5, "%", remedy, low=True)
    peaks = np.array([np.abs(cir.samples.astype(np.int32)).max() for cir in filled])
    clipped = float(np.mean(peaks >= SATURATED))
    yield _judge("share of saturated CIRs", clipped, 0.05, 0.5, "%", "increase the distance")
    ratio = float(np.median(peaks / [max(_noise(cir.samples), 1e-9) for cir in filled]))
    name, remedy = "peak over the noise before the first path", "reduce the distance"
    yield _judge(name, ratio, 10, 4, "times", remedy, low=True)


def _noise(samples: np.ndarray) -> float:
    lead = samples[: 2 * (WINDOW_LEAD - 1)].astype(np.float64)
    return float(np.sqrt(np.mean(lead**2))) if len(lead) else math.nan


def _model(o: Observation) -> Iterator[Check]:
    if not o.corrected:
        remedy = "ranges are published without correction; offsets work"
        yield Check("model", o.model, "trained for this radio", Verdict.WARNING, remedy)
        return
    verdict = Verdict.WARNING if "experimental" in o.model else Verdict.PASS
    remedy = "compare corrected ranges with known distances before use"
    yield Check("model", o.model, "not experimental", verdict, remedy)
    residual_m = abs(float(np.median([corrected.range_m for corrected in o.corrected])) - o.distance_m)
    remedy = "calibrate the offset of the pair"
    yield _judge("error of the median corrected range", residual_m, 0.15, 0.3, "m", remedy)
    refused = sum(not corrected.status.is_corrected for corrected in o.corrected) / len(o.corrected)
    remedy = "the model does not fit this radio or site"
    yield _judge("share of ranges without correction", refused, 0.2, 0.8, "%", remedy)
