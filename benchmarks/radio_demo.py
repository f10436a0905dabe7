"""`make radio-demo`: range with modelled DW1000s, and run driver and mitigator in ROS 2.

python -m benchmarks radio-demo [--seconds S]

A tag and four anchors are in the simulated flat; each is an emulated EVB1000 with its USB-to-SPI protocol, in wall-clock
time. The measurements of the chips, including NLOS errors, follow from the CIRs of the simulator.
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

from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.equipment.probe import Probe
from benchmarks.equipment.processes import NodeProcesses, run_demo
from uwb_mitigation.nodes.monitor import REFRESH_HZ
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.simulation.scene import ANCHORS
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.ros import topics

TAG_POSITIONS = ((6.5, 3.1), (6.501, 3.1), (6.5, 3.101))
"""Position of the tag, a corner of the robot's route: one anchor in LOS, the others behind concrete."""

RADIO_PARAMETERS = ("radio.channel:=2", "radio.preamble:=1024")
"""Radio settings of the simulator."""

TIMEOUT_S = 180.0
"""Timeout until each anchor has ranged once, on a busy computer."""


class RadioListener:
    """Collects corrected ranges by anchor, and the state of the radios from the driver."""

    def __init__(self, probe: Probe) -> None:
        self.ranges: dict[int, list[tuple[float, float]]] = defaultdict(list)
        self.problem = "the driver publishes no diagnostics"
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
            self.problem = f"driver: {status.message}"
            values = {value.key: value.value for value in status.values}
            for number in range(1, 1 + len(ANCHORS)):
                address = values.get(f"radio {number}: address")
                if address is not None:
                    self.boards[int(address, 16)] = number

    def table(self, true_m: Mapping[int, float]) -> Table:
        """Return a table of means by anchor, m; `true_m` by board."""
        table = Table(title="simulated ranges of emulated radios: mean, m", title_justify="left")
        for name in ("anchor", "ranges", "raw", "corrected", "true"):
            table.add_column(name, justify="right")
        for number, rows in self._by_board().items():
            raw, corrected = np.mean(rows, axis=0)
            table.add_row(
                str(number), str(len(rows)), f"{raw:.3f}", f"{corrected:.3f}", f"{true_m[number]:.3f}"
            )
        return table

    @property
    def missing_anchors(self) -> list[int]:
        """Return the anchors that have not ranged or are still unknown."""
        return sorted(set(range(1, 1 + len(ANCHORS))) - set(self._by_board()))

    def _by_board(self) -> dict[int, list[tuple[float, float]]]:
        boards = self.boards.copy()
        known = {
            boards[anchor]: rows.copy() for anchor, rows in self.ranges.copy().items() if anchor in boards
        }
        return dict(sorted(known.items()))


def run(console: Console, seconds: float) -> list[str]:
    """Start boards and nodes, and show their ranges; return the failures."""
    with (
        SimulatedSource(route=TAG_POSITIONS) as source,
        EmulatedEvb1000s(source, boards=1 + len(ANCHORS)) as boards,
        spinning_node(Probe) as probe,
    ):
        listener = RadioListener(probe)
        with NodeProcesses() as nodes:
            nodes.start("mitigator")
            corrected = probe.resolve_topic_name(topics.RANGE_CORRECTED)
            nodes.wait(
                lambda: probe.count_publishers(corrected) > 0, "the mitigator did not start: see above"
            )
            ports = ",".join(boards.ports)
            nodes.start("driver", "source:=evb1000", f"port:={ports}", *RADIO_PARAMETERS)
            console.print(f"a tag and {len(ANCHORS)} anchors, all emulated: {ports}", soft_wrap=True)
            ends_s, started = time.monotonic() + TIMEOUT_S, False
            with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
                while time.monotonic() < ends_s and nodes.running:
                    if not started and not listener.missing_anchors:
                        started, ends_s = True, time.monotonic() + seconds
                    live.update(listener.table(dict(enumerate(boards.distances_m))))
                    time.sleep(1 / REFRESH_HZ)
            # A live table writes the final line break only on a terminal.
            if not console.is_terminal:
                console.line()
        failures = nodes.failures + ([] if boards.failure is None else [str(boards.failure)])
    if not listener.ranges:
        failures.append(f"no range within {TIMEOUT_S:g} s; {listener.problem}")
    elif listener.missing_anchors:
        failures.append(
            f"no range with anchors {', '.join(map(str, listener.missing_anchors))}; {listener.problem}"
        )
    return failures


def main(seconds: float) -> int:
    """Run the demonstration and return its exit code."""
    return run_demo("radio-demo", lambda console: run(console, seconds))
