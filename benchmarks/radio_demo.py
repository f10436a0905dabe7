"""`make radio-demo`: the firmware's exchange on modelled DW1000s, through driver and mitigator over real ROS 2.

python -m benchmarks radio-demo [--seconds S]

A tag stands in the simulated flat, with four anchors; each is an emulated EVB1000 behind its USB-to-SPI protocol, in
wall-clock time. What the chips measure, errors out of sight included, follows from the simulator's CIRs.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rich.console import Console
from rich.live import Live
from rich.table import Table
from uwb_mitigation_msgs.msg import RangeCorrected

from benchmarks.dw1000_model.evb1000 import EmulatedEvb1000s
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes import processes, topics
from uwb_mitigation.nodes.monitor import REFRESH_HZ
from uwb_mitigation.nodes.processes import Probe, wait, watching
from uwb_mitigation.sources.simulated import SimulatedSource
from uwb_mitigation.sources.simulation.scene import ANCHORS

PLACE = ((6.5, 3.1), (6.501, 3.1), (6.5, 3.101))
"""Where the tag stands, a corner of the robot's route: one anchor in sight, the others behind concrete."""

RADIO = ("radio.channel:=2", "radio.preamble:=1024")
"""As the simulator's radio."""

PATIENCE_S = 60.0
"""Until each anchor has ranged once, on a computer that has other work."""


class RadioListener:
    """Keeps corrected ranges by anchor, and what the driver says of its radios."""

    def __init__(self, probe: Probe) -> None:
        self.ranges: dict[int, list[tuple[float, float]]] = defaultdict(list)
        self.problem = "the driver says nothing"
        self.boards: dict[int, int] = {}
        probe.subscribe(RangeCorrected, topics.RANGE_CORRECTED, self._on_corrected)
        probe.subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics)

    def _on_corrected(self, message: RangeCorrected) -> None:
        if math.isfinite(message.range):
            self.ranges[message.anchor_id].append((message.range_raw, message.range))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if not status.name.startswith("driver"):
                continue
            self.problem = f"the driver says: {status.message}"
            facts = {fact.key: fact.value for fact in status.values}
            for number in range(1, 1 + len(ANCHORS)):
                address = facts.get(f"radio {number}: address")
                if address is not None:
                    self.boards[int(address, 16)] = number

    def table(self, true_m: Mapping[int, float]) -> Table:
        """Means by anchor, m; `true_m` by board."""
        table = Table(title="simulated, emulated only: mean, m", title_justify="left")
        for name in ("anchor", "ranges", "raw", "corrected", "true"):
            table.add_column(name, justify="right")
        for number, rows in self._by_board().items():
            raw, corrected = np.mean(rows, axis=0)
            table.add_row(
                str(number), str(len(rows)), f"{raw:.3f}", f"{corrected:.3f}", f"{true_m[number]:.3f}"
            )
        return table

    @property
    def silent(self) -> list[int]:
        """Anchors that have not ranged, or are not known yet."""
        return sorted(set(range(1, 1 + len(ANCHORS))) - set(self._by_board()))

    def _by_board(self) -> dict[int, list[tuple[float, float]]]:
        boards = self.boards.copy()
        known = {
            boards[anchor]: rows.copy() for anchor, rows in self.ranges.copy().items() if anchor in boards
        }
        return dict(sorted(known.items()))


def run(console: Console, seconds: float) -> int:
    """Start boards and nodes, and show what they say. Returns the exit code."""
    with (
        SimulatedSource(route=PLACE) as source,
        EmulatedEvb1000s(source, boards=1 + len(ANCHORS)) as boards,
        watching(Probe) as probe,
    ):
        listener = RadioListener(probe)
        nodes = {"mitigator": processes.start("mitigator")}
        try:
            corrected = probe.resolve_topic_name(topics.RANGE_CORRECTED)
            wait(
                lambda: probe.count_publishers(corrected) > 0,
                "the mitigator did not come up: see its message above",
                [nodes["mitigator"]],
            )
            ports = ",".join(boards.ports)
            nodes["driver"] = processes.start("driver", "source:=evb1000", f"port:={ports}", *RADIO)
            console.print(f"a tag and {len(ANCHORS)} anchors, all emulated: {ports}", soft_wrap=True)
            patience = ended = time.monotonic() + PATIENCE_S
            started = False
            with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
                while time.monotonic() < (ended if started else patience):
                    if any(node.poll() is not None for node in nodes.values()):
                        break
                    if not started and not listener.silent:
                        started, ended = True, time.monotonic() + seconds
                    live.update(listener.table(dict(enumerate(boards.distances_m))))
                    time.sleep(1 / REFRESH_HZ)
            # A live table ends its last line on a terminal only.
            if not console.is_terminal:
                console.line()
        finally:
            codes = processes.stop(*nodes.values())
        failed = [
            f"{name} ended with exit code {code}" for name, code in zip(nodes, codes, strict=True) if code
        ]
        if boards.failure is not None:
            failed.append(str(boards.failure))
    if not listener.ranges:
        failed.append(f"no range within {PATIENCE_S:g} s; {listener.problem}")
    elif listener.silent:
        failed.append(f"no range with anchors {', '.join(map(str, listener.silent))}; {listener.problem}")
    for failure in failed:
        console.print(failure, style="red", markup=False)
    return 1 if failed else 0


def main(seconds: float) -> int:
    """Run the demonstration and return its exit code."""
    processes.isolate()
    console = Console()
    try:
        return run(console, seconds)
    except UwbMitigationError as error:
        console.print(f"radio-demo: {error}", style="red", markup=False)
        return 1
    except KeyboardInterrupt:
        return 130
