"""Make the pictures of the README and of the documentation. Both use simulated ranges.

`raw_and_corrected.png` contains maps of two simulated drives with calibrated offsets: positions by least squares on raw ranges,
by the locator on raw ranges, and by the locator on corrected ranges. `viewer.png` and `viewer_narrow.png` are screenshots in Chromium.

    python docs/pictures.py [map]
"""

from __future__ import annotations

import socket
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
from benchmarks.position_data import simulated_run  # noqa: E402
from benchmarks.positions import WARM_UP_S, locate  # noqa: E402
from benchmarks.sites import FLATS, Drive  # noqa: E402
from uwb_mitigation.positioning.online.initialization import snapshot  # noqa: E402
from uwb_mitigation.positioning.track_errors import track_errors  # noqa: E402
from uwb_mitigation.simulation.simulated import SimulatedSource  # noqa: E402
from uwb_mitigation.types.anchors import dump_anchors  # noqa: E402
from uwb_mitigation.types.offsets import Offsets  # noqa: E402
from uwb_mitigation.types.stamps import NS_PER_S  # noqa: E402
from uwb_mitigation.types.tracks import Track  # noqa: E402
from uwb_mitigation.viewer.palette import BLUE, GREY, NIGHT, VERMILLION  # noqa: E402

PICTURES = REPOSITORY / "docs" / "pictures"
SIMULATED_HZ = 40.0
WATCHED_S = 40.0
"""Duration before the page is opened, for a trail and most of a strip chart."""
FILLED_S = 7.0
"""Duration before the screenshots are taken, for a waterfall plot."""


SHOWN_S = 60.0
"""Duration of the drives that the maps show: one round through the flat."""
SHOWN_SEED = 906
SHOWN_BUILDINGS = {"brick": "Brick walls", "open": "Open space"}


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
    """Plot maps of simulated drives: where the correction matters, and where it does not."""
    figure, panels = plt.subplots(1, 2, figsize=(9.0, 4.9), dpi=90, sharey=True)
    for axes, (building, title) in zip(panels, SHOWN_BUILDINGS.items(), strict=True):
        plan = FLATS[building]
        for wall in plan.walls:
            (x0, y0), (x1, y1) = wall.start, wall.end
            size = x1 - x0 + wall.thickness_m, y1 - y0 + wall.thickness_m
            corner = x0 - wall.thickness_m / 2, y0 - wall.thickness_m / 2
            axes.add_patch(Rectangle(corner, *size, color=GREY, lw=0))
        for screen in plan.screens:
            axes.plot(*zip(screen.start, screen.end, strict=True), color=GREY, lw=3, ls=(0, (2, 1)))
        axes.add_patch(Rectangle((0, 0), *plan.size, fill=False, color=GREY, lw=3))
        drive = Drive(SHOWN_SEED, 0, 6, SHOWN_S, building)
        run = simulated_run(building, "", drive)
        offsets = Offsets(anchors={anchor: float(m) for anchor, m in enumerate(drive.offset_m, 1)})
        raw = replace(
            run.ranges, range_m=np.maximum(run.ranges.range_m - drive.offset_m[run.ranges.anchor], 0.0)
        )
        shown: list[tuple[Track, str, dict[str, Any]]] = [
            (snapshot(run.anchors, raw, run.height), "raw ranges, least squares", {"color": VERMILLION, "lw": 0, "marker": "+", "ms": 3}),
            (locate(run, raw), "raw ranges, locator", {"color": VERMILLION, "lw": 1.2}),
            (locate(run, run.corrected(offsets=offsets)), "corrected ranges, locator", {"color": BLUE, "lw": 2.2}),
        ]  # fmt: skip
        truth = run.truth.take(run.truth.stamp_ns >= run.truth.stamp_ns[0] + round(WARM_UP_S * NS_PER_S))
        errors = []
        for track, label, style in shown:
            after = track.position[track.stamp_ns >= truth.stamp_ns[0], :2]
            axes.plot(*after.T, label=label, **style)
            errors.append(f"{track_errors(track, truth).rmse:.2f}")
        axes.plot(*truth.position[:, :2].T, color=NIGHT, lw=1.2, ls="--", label="true path")
        axes.plot(*run.anchors.position[:, :2].T, "^", color=NIGHT, ms=9, label="anchor")
        axes.set(aspect="equal", xlabel="x, m", xlim=(-0.7, 8.3), ylim=(-0.5, 7.7))
        axes.set_title(f"{title}\nRMSE {errors[0]} / {errors[1]} / {errors[2]} m", fontsize=11)
    panels[0].set_ylabel("y, m")
    figure.legend(
        *panels[0].get_legend_handles_labels(), fontsize=9, loc="lower center", ncols=5, frameon=False
    )
    figure.tight_layout(rect=(0, 0.06, 1, 1))
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
