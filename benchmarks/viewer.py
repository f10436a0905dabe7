"""Measure the cost of the viewer: processor time with and without open pages, and its effect on the mitigator."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from functools import partial
from statistics import median

from uwb_mitigation_msgs.msg import RangeCorrected

from benchmarks.equipment.page_clients import PageClients
from benchmarks.equipment.processes import wait
from benchmarks.nodes import (
    Bench,
    ProgressCallback,
    Step,
    Subject,
    open_bench,
    process_usage,
    rate_ratio,
    run_steps,
    searches,
)
from uwb_mitigation.types.ros import topics

RATE_HZ = 100.0
SENT_HZ = 500
_SLICES = 5
PAGES = (0, 1, 10)
_SETTLE_S = 3.0


NO_VIEWER, NO_PAGE, ONE_PAGE = SUBJECTS = ("no viewer", "no open page", "an open page")
"""Each subject has a driver and a mitigator, and possibly a viewer with or without a page."""


@dataclass(frozen=True, slots=True)
class ViewerCosts:
    """Cost of a viewer next to a driver and a mitigator, all in one session as in a launch.

    Attributes:
        core_share: processor time of the viewer per second at `RATE_HZ`, {open pages: share of a core}.
        range_us: processor time of driver and mitigator per range at `SENT_HZ`, {one of `SUBJECTS`: us}.
        rates_hz: maximum rate of the mitigator without loss, {one of `SUBJECTS`: rate of each search}.
    """

    core_share: dict[int, float]
    range_us: dict[str, float]
    rates_hz: dict[str, list[float]]

    @property
    def rate_ratios(self) -> dict[str, float | None]:
        """Return the rates of the mitigator relative to that without a viewer."""
        medians_hz = {name: median(rates_hz) for name, rates_hz in self.rates_hz.items()}
        return {name: rate_ratio(rate_hz, medians_hz[NO_VIEWER]) for name, rate_hz in medians_hz.items()}


def measure(repeats: int, seconds: float, advance: ProgressCallback) -> ViewerCosts:
    """Measure a viewer.

    Args:
        repeats: number of searches for each maximum rate.
        seconds: duration of the measurement of each share of a core.
        advance: called with the progress.

    Raises:
        UwbMitigationError: a node did not start, or no ranges arrive.
    """
    with open_bench() as bench:
        subjects = [
            Subject(
                bench, name.replace(" ", "_"), RangeCorrected, topics.RANGE_CORRECTED, "mitigator", "driver"
            )
            for name in SUBJECTS
        ]
        _, unwatched, watched = subjects
        url, pid = _start_viewer(bench, unwatched.name)
        watched_url, _ = _start_viewer(bench, watched.name)
        core_share: dict[int, float] = {}

        def measure_pages(pages: int) -> None:
            with PageClients(url, pages):
                time.sleep(_SETTLE_S)
                before_s, began_s = process_usage(pid).cpu_s, time.monotonic()
                time.sleep(seconds)
                passed_s = time.monotonic() - began_s
                core_share[pages] = (process_usage(pid).cpu_s - before_s) / passed_s

        unwatched.play(RATE_HZ)
        page_steps: list[Step] = [
            (f"the viewer with {pages} open pages", _SETTLE_S + seconds, partial(measure_pages, pages))
            for pages in PAGES
        ]
        run_steps(
            [*page_steps, ("pausing", 0.1, unwatched.pause)], lambda text, share: advance(text, 0.3 * share)
        )
        with PageClients(watched_url, 1):
            for subject in subjects:
                subject.warm_up()
            slices: list[Step] = [
                (f"processor time, {name}", 2.0, partial(_measure_slice, subject))
                for _ in range(_SLICES)
                for name, subject in zip(SUBJECTS, subjects, strict=True)
            ]
            steps = [*slices, *searches(subjects, repeats)]
            run_steps(steps, lambda text, share: advance(text, 0.3 + 0.7 * share))
    figures = {name: subject.figures for name, subject in zip(SUBJECTS, subjects, strict=True)}
    return ViewerCosts(
        core_share,
        {name: of.chain_cpu_us_per_message for name, of in figures.items()},
        {name: of.rates_hz for name, of in figures.items()},
    )


def _measure_slice(subject: Subject) -> None:
    subject.measure_latency(SENT_HZ, 2.0)


def _start_viewer(bench: Bench, namespace: str) -> tuple[str, int]:
    """Start a viewer; return its page and process id."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    process = bench.start(f"viewer port:={port}", namespace)

    def serves() -> bool:
        try:
            socket.create_connection(("localhost", port), 0.1).close()
        except OSError:
            return False
        return True

    wait(serves, "the viewer does not serve its page", [process])
    return f"http://localhost:{port}/", process.pid
