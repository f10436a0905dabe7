"""What `NODE --help` prints. No ROS here: it answers where ROS is not sourced, and at once."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from uwb_mitigation.nodes.parameter_tables import DRIVER, LOCATOR, MITIGATOR, VIEWER, Parameter

_WIDTH = 96


@dataclass(frozen=True, slots=True)
class Usage:
    """Of one executable: what it does, its parameters, and commands to begin with."""

    summary: str
    parameters: Sequence[Parameter]
    examples: Sequence[str]


USAGES = {
    "driver": Usage(
        "Publishes UWB ranges with their CIR on uwb/range_raw: from a board on a serial port, a recording or "
        "the simulator.",
        DRIVER,
        (
            "driver --ros-args -p source:=serial -p port:=/dev/ttyACM0",
            "driver --ros-args -p source:=mcap -p path:=recording.mcap",
            "driver --ros-args -p source:=simulated",
        ),
    ),
    "mitigator": Usage(
        "Subscribes to uwb/range_raw, and publishes corrected ranges with variance and status on "
        "uwb/range_corrected.",
        MITIGATOR,
        ("mitigator", "mitigator --ros-args -p model:=int8.onnx", "mitigator --ros-args -r __ns:=/board1"),
    ),
    "locator": Usage(
        "Subscribes to uwb/range_corrected, and publishes where the tags are: uwb/pose, uwb/odometry, "
        "uwb/pose_smoothed (a second later) and uwb/anchors (markers).",
        LOCATOR,
        (
            "locator --ros-args -p anchors:=anchors.yaml",
            "locator --ros-args -p anchors:=anchors.yaml -p level:=true -p height:=0.4",
        ),
    ),
    "pipeline": Usage(
        "Driver and mitigator in one process, and the locator where `anchors` is given: the same topics and "
        "parameters for less of the processor.",
        tuple({row.name: row for row in (*DRIVER, *MITIGATOR, *LOCATOR)}.values()),
        ("pipeline --ros-args -p source:=serial -p port:=/dev/ttyACM0",),
    ),
    "monitor": Usage(
        "Shows raw and corrected ranges live in the terminal, and a summary after Ctrl-C.",
        (),
        ("monitor", "monitor --ros-args -r __ns:=/board1"),
    ),
    "viewer": Usage(
        "Serves a page for the browser on what passes on the topics: map, pairs, channel impulse responses, "
        "diagnostics. It reads, and never writes.",
        VIEWER,
        (
            "viewer",
            "viewer --ros-args -p anchors:=anchors.yaml",
            "viewer --ros-args -p host:=0.0.0.0 -p port:=8080",
        ),
    ),
}


def text_for(node: str) -> str:
    """The help of one executable."""
    usage = USAGES[node]
    lines = [f"usage: {node} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] ...]", ""]
    lines += [*textwrap.wrap(usage.summary, _WIDTH), "", *(f"    {line}" for line in usage.examples)]
    if usage.parameters:
        lines += ["", "parameters, with their defaults (* = may be set while it runs):"]
    for row in usage.parameters:
        lines.append(f"  {row.name}:={row.default_text}{' *' if row.live else ''}")
        lines += textwrap.wrap(
            f"{row.description} ({row.valid})", _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6
        )
    return "\n".join(lines)
