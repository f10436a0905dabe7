"""Measure the ranging of the firmware on modelled chips: error, rates, robustness. Virtual time except for EVB1000s."""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.equipment.dw1000_model.boards import ModelledAir, SerialLink
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.radios import evb1000
from uwb_mitigation.radios.dw1000.port import ChipSettings
from uwb_mitigation.radios.settings import RadioSettings, Role
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.types.measurement import DEVICE_TIME_WRAP

PPM_PAIRS = ((-20.0, 20.0), (-10.0, 10.0), (0.0, 0.0), (10.0, -10.0), (20.0, -20.0))
DISTANCES_M = (0.3, 1.0, 5.01, 20.0, 100.0)

INFERENCE_CYCLES = 412_570
"""Estimated cycles of the shipped network with K = 157 (`python -m benchmarks firmware`)."""

PROCESSOR_HZ = 64e6
SPI_OVERHEAD_S = 10e-6
"""Assumed overhead of a microcontroller for each SPI transaction."""

WRONG_M = 0.1

_BEFORE_WRAP_TICKS = 3 * 10**9
_LOSS, _DAMAGE = 0.1, 0.01
_ANCHORS_M = (2.0, 5.5, 9.0, 14.0)
_MAX_PAUSE_S = 0.25
_TIMEOUT_S = 20.0
_WARM_UP_S = 3.0
_START_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class Ranging:
    """Errors of one pair of clocks at one distance; the counter of the tag wraps during the run."""

    ppm_a: float
    ppm_b: float
    distance_m: float
    exchanges: int
    mean_error_m: float
    sd_m: float


@dataclass(frozen=True, slots=True)
class RadioSoak:
    """Results of a soak.

    Attributes:
        exchanges: number of started exchanges.
        delivered: number of ranges.
        wrong: number of ranges with an error of more than `WRONG_M`.
        disturbances: number of chip resets and of anchors that disappeared and returned.
        longest_recovery_s: from a reset or the return of an anchor to its next range; virtual time.
        lost: {cause: number of exchanges}.
        memory_growth_mb: of this process, from a tenth of the exchanges to the end.
    """

    exchanges: int
    delivered: int
    wrong: int
    disturbances: int
    longest_recovery_s: float
    lost: dict[str, int]
    memory_growth_mb: float


def ranging(seconds: float, advance: Callable[[], None]) -> list[Ranging]:
    """Range with each of `PPM_PAIRS` at each of `DISTANCES_M` for a duration in virtual time."""
    rows = []
    for (ppm_a, ppm_b), distance_m in itertools.product(PPM_PAIRS, DISTANCES_M):
        with ModelledAir() as air:
            tag = air.add(RadioSettings(), ppm=ppm_a, clock_ticks=DEVICE_TIME_WRAP - _BEFORE_WRAP_TICKS)
            anchor = air.add(RadioSettings(role=Role.ANCHOR), ppm=ppm_b)
            air.set_pair(tag, anchor, Pair(distance_m))
            air.run(seconds)
            measured, _ = air.ranges()
        errors = measured["range_m"] - distance_m
        rows.append(Ranging(ppm_a, ppm_b, distance_m, len(errors), float(errors.mean()), float(errors.std())))
        advance()
    return rows


def serial_rate_hz(mode: Mode) -> float:
    """Return the ranges per second over a serial line of 921600 baud, in mode HOST with 157 samples each; virtual time."""
    seconds = 5.0
    serial_link = SerialLink(
        mode=mode, inference_s=INFERENCE_CYCLES / PROCESSOR_HZ, overhead_s=SPI_OVERHEAD_S
    )
    with ModelledAir() as air:
        tag = air.add(RadioSettings(), serial_link=serial_link)
        air.set_pair(tag, air.add(RadioSettings(role=Role.ANCHOR)), Pair(5))
        air.run(seconds)
        rows, _ = air.ranges()
        return (len(rows) - air.measurements_lost(tag)) / seconds


def evb1000_rate_hz(seconds: float) -> float:
    """Return the ranges per second of two emulated EVB1000s on this computer, 157 samples each; wall-clock time.

    Raises:
        UwbMitigationError: no ranges arrive.
    """
    with tempfile.TemporaryDirectory() as folder, _emulated(Path(folder) / "board") as paths:
        settings = [
            ChipSettings(str(path), RadioSettings(role=role))
            for path, role in zip(paths, (Role.TAG, Role.ANCHOR), strict=True)
        ]
        ports = evb1000.open(settings, lambda event: None)
        try:
            until = time.monotonic() + _START_TIMEOUT_S
            while not ports[0].status.ranged:
                if time.monotonic() > until:
                    problem = ports[0].problem or "no answer"
                    raise UwbMitigationError(f"emulated EVB1000s do not range: {problem}")
                time.sleep(0.05)
            time.sleep(_WARM_UP_S)
            before, began = ports[0].status.ranged, time.monotonic()
            time.sleep(seconds)
            return (ports[0].status.ranged - before) / (time.monotonic() - began)
        finally:
            for port in ports:
                port.close()


@contextlib.contextmanager
def _emulated(prefix: Path) -> Iterator[tuple[Path, Path]]:
    """Run two EVB1000s in a separate process, so that they do not use processor time of this one."""
    paths = (Path(f"{prefix}0"), Path(f"{prefix}1"))
    # Use a clean link: a simulator in that process would sometimes delay the boards.
    options = ("emulate-evb1000", "--link", str(prefix), "--distance", "5")
    process = subprocess.Popen([sys.executable, "-m", "benchmarks", *options], stdout=subprocess.DEVNULL)
    try:
        until = time.monotonic() + _START_TIMEOUT_S
        while not all(path.exists() for path in paths):
            if process.poll() is not None or time.monotonic() > until:
                raise UwbMitigationError("emulated EVB1000s do not start")
            time.sleep(0.05)
        yield paths
    finally:
        process.terminate()
        process.wait()


def soak(exchanges: int, seed: int, advance: Callable[[int], None]) -> RadioSoak:
    """Soak a tag and four anchors: 10 % of frames lost, 1 % damaged, chips reset, anchors temporarily absent."""
    random = np.random.default_rng(seed)
    process = psutil.Process()
    with ModelledAir(seed) as air:
        tag = air.add(RadioSettings(window=0), ppm=11)
        anchors = {
            air.add(RadioSettings(role=Role.ANCHOR), ppm=ppm): Pair(distance_m, loss=_LOSS, damage=_DAMAGE)
            for distance_m, ppm in zip(_ANCHORS_M, (-20, -7, 5, 19), strict=True)
        }
        for anchor, path in anchors.items():
            air.set_pair(tag, anchor, path)
        now_s = air.run(1.0)
        monitor = _SoakMonitor(air, anchors)
        monitor.count_ranges(now_s)
        memory_mb: float | None = None
        disturbances = 0
        while (tried := air.counts(tag)["tried"]) < exchanges:
            advance(tried)
            if memory_mb is None and tried > exchanges / 10:
                memory_mb = process.memory_info().rss / 1e6
            disturbances += 1
            disturbance = random.integers(0, 3)
            anchor = int(random.choice(list(anchors)))
            if disturbance == 0:
                air.set_pair(tag, anchor, None)
                monitor.count_ranges(air.run(float(random.uniform(0.05, 1.0))))
                air.set_pair(tag, anchor, anchors[anchor])
                expected = {anchor}
            else:
                air.reset(tag if disturbance == 1 else anchor)
                expected = set(anchors) if disturbance == 1 else {anchor}
            now_s = monitor.await_all(expected)
            now_s = monitor.count_ranges(air.run(float(random.uniform(0, _MAX_PAUSE_S))))
        counts = air.counts(tag)
    end_mb = process.memory_info().rss / 1e6
    lost = {
        name: counts[name] for name in ("no_answer", "late", "timeout", "damaged", "implausible", "broken")
    }
    return RadioSoak(
        exchanges=counts["tried"],
        delivered=monitor.delivered,
        wrong=monitor.wrong,
        disturbances=disturbances,
        longest_recovery_s=monitor.longest_s,
        lost=lost,
        memory_growth_mb=end_mb - (memory_mb if memory_mb is not None else end_mb),
    )


class _SoakMonitor:
    """Collects the ranges of a soak, and measures the time until an anchor ranges again."""

    _SLICE_S = 0.01

    def __init__(self, air: ModelledAir, anchors: dict[int, Pair]) -> None:
        self._air = air
        self._by_address = {air.address(anchor): anchor for anchor in anchors}
        self._distances_m = {anchor: path.distance_m for anchor, path in anchors.items()}
        self.delivered = 0
        self.wrong = 0
        self.longest_s = 0.0

    def count_ranges(self, now_s: float) -> float:
        """Count the new ranges; return the time."""
        self._rows()
        return now_s

    def await_all(self, expected: set[int]) -> float:
        """Run until each of these anchors has ranged; return the time.

        Raises:
            UwbMitigationError: an anchor no longer ranges.
        """
        now_s = began_s = self._air.run(0.0)
        # Ignore earlier ranges.
        self._rows()
        missing = set(expected)
        while missing:
            if now_s - began_s > _TIMEOUT_S:
                raise UwbMitigationError(f"no range within {_TIMEOUT_S} s of virtual time")
            now_s = self._air.run(self._SLICE_S)
            for row in self._rows():
                missing.discard(self._by_address[int(row["anchor"])])
        self.longest_s = max(self.longest_s, now_s - began_s)
        return now_s

    def _rows(self) -> NDArray[np.void]:
        rows, _ = self._air.ranges()
        self.delivered += len(rows)
        for row in rows:
            distance_m = self._distances_m[self._by_address[int(row["anchor"])]]
            self.wrong += bool(abs(row["range_m"] - distance_m) > WRONG_M)
        return rows
