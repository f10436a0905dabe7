"""Make the pictures of the README and of the documentation. Both use simulated ranges.

`raw_and_corrected.png` compares positions and range errors of a simulated drive before and after correction.
`viewer.png` and `viewer_narrow.png` are screenshots of the viewer in Chromium.

    python docs/pictures.py
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "test"))

from browser import Browser, chromium  # noqa: E402

from uwb_mitigation.nodes import processes  # noqa: E402
from uwb_mitigation.positioning.anchors import dump_anchors  # noqa: E402
from uwb_mitigation.positioning.geometry import Height  # noqa: E402
from uwb_mitigation.positioning.tag_estimator import EstimatorConfig  # noqa: E402
from uwb_mitigation.processing.tracking import track_tag  # noqa: E402
from uwb_mitigation.sources.anchors_file import load_anchors  # noqa: E402
from uwb_mitigation.sources.recorded_ranges import read_ranges  # noqa: E402
from uwb_mitigation.sources.simulated import SimulatedSource  # noqa: E402

PICTURES = REPOSITORY / "docs" / "pictures"
SIMULATED_HZ = 40.0
WATCHED_S = 40.0
"""Duration before the page is opened, for a trail and most of a strip chart."""
FILLED_S = 7.0
"""Duration before the screenshots are taken, for a waterfall plot."""


SHOWN_S = 60.0
"""Duration of the drive that the map shows: one round through the flat."""
ANCHOR = 2
"""Row of the anchor whose range errors are plotted."""


def reduce_colours(path: Path) -> None:
    """Reduce a PNG file to 256 colours; MAXCOVERAGE keeps colours of small areas."""
    shown = Image.open(path).convert("RGB")
    few = shown.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.relative_to(REPOSITORY)}: {path.stat().st_size / 1000:.0f} kB")


def save(browser: Browser, name: str) -> None:
    """Save a screenshot."""
    path = PICTURES / f"{name}.png"
    browser.driver.save_screenshot(str(path))
    reduce_colours(path)


def plot_raw_and_corrected() -> None:
    """Plot a simulated drive: positions on the left, range errors of one anchor on the right."""
    command = [sys.executable, "-m", "uwb_mitigation.commands.cli"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raw, corrected = folder / "drive.mcap", folder / "corrected.mcap"
        simulate = ["data", "simulate", "--like", "drive", "--ranges", "1300", "-o", str(raw)]
        subprocess.run([*command, *simulate], check=True)
        subprocess.run([*command, "process", str(raw), "--offsets", "0.22", "-o", str(corrected)], check=True)
        anchors = load_anchors(folder / "drive.anchors.yaml")
        (recording,) = read_ranges(corrected, anchors).tags
    tracks = track_tag(recording, EstimatorConfig(anchors, height=Height(0.0)))
    truth, begin_ns = recording.truth, recording.truth.stamp_ns[0]
    shown: list[tuple[Any, dict[str, Any]]] = [
        (truth, {"color": "black", "lw": 2.5, "label": "true path"}),
        (
            tracks.snapshot,
            {"color": "tab:orange", "ls": "", "marker": "o", "ms": 3, "label": "raw, least squares"},
        ),
        (tracks.live, {"color": "tab:blue", "lw": 1.5, "label": "corrected, locator"}),
    ]

    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.8), width_ratios=(1.0, 1.3), dpi=90)
    for track, style in shown:
        part = track.stamp_ns - begin_ns < SHOWN_S * 1e9
        left.plot(*track.position[part, :2].T, **style)
    left.plot(*anchors.position[:, :2].T, "^", color="tab:red", ms=10, label="anchors")
    left.set(aspect="equal", xlabel="x, m", ylabel="y, m", title="Position of the tag")
    left.legend(fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    for ranges, colour, label in (
        (recording.raw, "tab:orange", "raw"),
        (recording.ranges, "tab:blue", "corrected"),
    ):
        own = (ranges.anchor == ANCHOR) & (ranges.stamp_ns - begin_ns < SHOWN_S * 1e9)
        stamp_ns = ranges.stamp_ns[own]
        position = np.stack([np.interp(stamp_ns, truth.stamp_ns, axis) for axis in truth.position.T], axis=1)
        error = ranges.range_m[own] - np.linalg.norm(position - anchors.position[ANCHOR], axis=1)
        mean = np.abs(error).mean()
        time_s = (stamp_ns - begin_ns) / 1e9
        right.plot(
            time_s, error, "o-", color=colour, ms=3, lw=0.8, label=f"{label}: mean |error| {mean:.2f} m"
        )
    right.axhline(0.0, color="black", lw=1.0)
    right.set(
        xlabel="time, s", ylabel="measured minus true range, m", title=f"Range error, anchor {ANCHOR + 1}"
    )
    right.legend(fontsize=9, loc="upper right")
    figure.tight_layout()
    path = PICTURES / "raw_and_corrected.png"
    figure.savefig(path)
    reduce_colours(path)


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    plot_raw_and_corrected()
    processes.isolate()
    anchors = SimulatedSource(rate_hz=SIMULATED_HZ).anchors
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        file = Path(folder, "anchors.yaml")
        file.write_text(dump_anchors(anchors), encoding="utf-8")
        nodes = [
            processes.start("viewer", f"port:={port}"),
            processes.start("mitigator"),
            processes.start("locator", f"anchors:={file}", "level:=true"),
            processes.start("driver", "source:=simulated", f"simulated_rate:={SIMULATED_HZ}"),
        ]
        try:
            time.sleep(WATCHED_S)
            browser.open(f"http://localhost:{port}/", 1280, 1170)
            browser.wait("the page", browser.ready)
            # CIRs come only while a page is open.
            time.sleep(FILLED_S)
            save(browser, "viewer")
            browser.resize(400, 800)
            time.sleep(2.0)
            save(browser, "viewer_narrow")
        finally:
            processes.stop(*nodes)


if __name__ == "__main__":
    main()
