"""Make the pictures of the README and of the documentation. Both use simulated ranges.

`raw_and_corrected.png` is a map of a simulated drive: positions by least squares on raw ranges, by the locator on raw
ranges, and by the locator on corrected ranges. `viewer.png` and `viewer_narrow.png` are screenshots in Chromium.

    python docs/pictures.py [map]
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from PIL import Image

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "test")]

from browser import Browser, chromium  # noqa: E402

from benchmarks.equipment import processes  # noqa: E402
from uwb_mitigation.positioning.geometry import Height  # noqa: E402
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig  # noqa: E402
from uwb_mitigation.positioning.recorded_tracks import track_tag  # noqa: E402
from uwb_mitigation.recordings.recorded_ranges import read_ranges  # noqa: E402
from uwb_mitigation.simulation.scene import FLAT  # noqa: E402
from uwb_mitigation.simulation.simulated import SimulatedSource  # noqa: E402
from uwb_mitigation.types.anchors import dump_anchors, load_anchors  # noqa: E402
from uwb_mitigation.viewer.palette import BLUE, GREY, NIGHT, VERMILLION  # noqa: E402

PICTURES = REPOSITORY / "docs" / "pictures"
SIMULATED_HZ = 40.0
WATCHED_S = 40.0
"""Duration before the page is opened, for a trail and most of a strip chart."""
FILLED_S = 7.0
"""Duration before the screenshots are taken, for a waterfall plot."""


SHOWN_S = 60.0
"""Duration of the drive that the map shows: one round through the flat."""
SETTLED_S = 3.0
"""Time of the first plotted position."""


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
    """Plot a map of a simulated drive, with the same filter on raw and on corrected ranges."""
    command = [sys.executable, "-m", "uwb_mitigation.commands.cli"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raw, corrected = folder / "drive.mcap", folder / "corrected.mcap"
        simulate = ["data", "simulate", "--like", "drive", "--ranges", "1300", "-o", str(raw)]
        subprocess.run([*command, *simulate], check=True)
        subprocess.run([*command, "process", str(raw), "--offsets", "0.22", "-o", str(corrected)], check=True)
        anchors = load_anchors(folder / "drive.anchors.yaml")
        (recording,) = read_ranges(corrected, anchors).tags
    config = EstimatorConfig(anchors, height=Height(0.0))
    corrected_tracks = track_tag(recording, config)
    raw_tracks = track_tag(replace(recording, ranges=recording.raw, corrected=False), config)
    figure, axes = plt.subplots(figsize=(9.0, 6.2), dpi=90)
    for wall in FLAT.walls:
        (x0, y0), (x1, y1) = wall.start, wall.end
        axes.add_patch(
            Rectangle(
                (x0 - wall.thickness_m / 2, y0 - wall.thickness_m / 2), x1 - x0 + wall.thickness_m, y1 - y0 + wall.thickness_m,
                color=GREY, lw=0,
            )
        )  # fmt: skip
    for screen in FLAT.screens:
        axes.plot(*zip(screen.start, screen.end, strict=True), color=GREY, lw=3, ls=(0, (2, 1)))
    axes.add_patch(Rectangle((0, 0), *FLAT.size, fill=False, color=GREY, lw=4))
    truth, begin_ns = recording.truth, recording.truth.stamp_ns[0]
    shown: list[tuple[Any, str, dict[str, Any]]] = [
        (
            raw_tracks.snapshot,
            "raw ranges, least squares",
            {"color": VERMILLION, "lw": 0, "marker": "+", "ms": 4},
        ),
        (raw_tracks.live, "raw ranges, locator", {"color": VERMILLION, "lw": 1.5}),
        (corrected_tracks.live, "corrected ranges, locator", {"color": BLUE, "lw": 3.0}),
        (truth, "true path", {"color": NIGHT, "lw": 1.5, "ls": "--"}),
    ]
    for track, label, style in shown:
        time_s = (track.stamp_ns - begin_ns) / 1e9
        part = (time_s > SETTLED_S) & (time_s < SHOWN_S)
        position = track.position[part, :2]
        if track is not truth:
            true = np.stack(
                [
                    np.interp(time_s[part], (truth.stamp_ns - begin_ns) / 1e9, axis)
                    for axis in truth.position.T[:2]
                ],
                axis=1,
            )
            rmse_m = np.sqrt(np.mean(np.sum((position - true) ** 2, axis=1)))
            label += f"\nRMSE {rmse_m:.2f} m"
        axes.plot(*position.T, label=label, **style)
    axes.plot(*anchors.position[:, :2].T, "^", color=NIGHT, ms=12, label="anchor")
    axes.plot([], [], color=GREY, lw=5, label="wall")
    axes.plot([], [], color=GREY, lw=3, ls=(0, (2, 1)), label="metal cabinet")
    axes.set(aspect="equal", xlabel="x, m", ylabel="y, m", xlim=(-1.2, 8.8), ylim=(-0.4, 8.0))
    axes.set_title("Simulated drive through a flat with concrete walls")
    axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.tight_layout()
    path = PICTURES / "raw_and_corrected.png"
    figure.savefig(path)
    reduce_colours(path)


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    plot_raw_and_corrected()
    if "map" in sys.argv:
        return
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
            browser.open(f"http://localhost:{port}/", 1280, 1420)
            browser.wait("the page", browser.ready)
            # CIRs come only while a page is open.
            time.sleep(FILLED_S)
            browser.click("button", "Fit")
            time.sleep(1.0)
            save(browser, "viewer")
            browser.resize(400, 1250)
            time.sleep(2.0)
            save(browser, "viewer_narrow")
        finally:
            processes.stop(*nodes)


if __name__ == "__main__":
    main()
