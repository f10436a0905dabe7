"""Make the pictures of the README and of the documentation. Both use simulated ranges.

`raw_and_corrected.png` contains maps of two simulated drives with calibrated offsets: positions by least squares on raw ranges,
by the locator on raw ranges, and by the locator on corrected ranges. The others are screenshots in Chromium: `viewer.png` and
`viewer_narrow.png` of live topics, `state_*.png` of the first screen for each state of the page.

    python docs/pictures.py [map] [live] [states]
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
from uwb_mitigation.commands.data import write_simulated  # noqa: E402
from uwb_mitigation.commands.offline.track import displaced_anchor, mitigation  # noqa: E402
from uwb_mitigation.positioning.online.initialization import snapshot  # noqa: E402
from uwb_mitigation.positioning.track_errors import track_errors  # noqa: E402
from uwb_mitigation.positioning.track_settings import TrackSettings  # noqa: E402
from uwb_mitigation.simulation.scene import ANCHORS, MORE_ANCHORS  # noqa: E402
from uwb_mitigation.simulation.simulated import SimulatedSource  # noqa: E402
from uwb_mitigation.types.anchors import AnchorMap, dump_anchors  # noqa: E402
from uwb_mitigation.types.measurement import Cir, Record  # noqa: E402
from uwb_mitigation.types.offsets import Offsets  # noqa: E402
from uwb_mitigation.types.stamps import NS_PER_S  # noqa: E402
from uwb_mitigation.types.tracks import Track  # noqa: E402
from uwb_mitigation.viewer.palette import BLUE, GREY, NIGHT, VERMILLION  # noqa: E402
from uwb_mitigation.viewer.playback import BagPlayer  # noqa: E402
from uwb_mitigation.viewer.server import ViewerServer  # noqa: E402
from uwb_mitigation.viewer.state import View  # noqa: E402

PICTURES = REPOSITORY / "docs" / "pictures"
SIMULATED_HZ = 40.0
WATCHED_S = 40.0
"""Duration before the page is opened, for a trail and most of a strip chart."""
FILLED_S = 7.0
"""Duration before the screenshots are taken, for the CIRs."""

DRIVE_RANGES = 1400
"""Number of ranges of the drives of the states, at 20 Hz: 70 s."""
OFFSET_M = 0.2
"""Antenna delays of the simulated radios."""
FIRST_SCREEN = 1280, 720

SHOWN_S = 60.0
"""Duration of the drives that the maps show: one round through the flat."""
SHOWN_SEED = 906
SHOWN_BUILDINGS = {"brick": "Brick walls", "open": "Open space"}


def reduce_colours(path: Path, count: int = 256) -> None:
    """Reduce a PNG file to a number of colours; MAXCOVERAGE keeps colours of small areas."""
    shown = Image.open(path).convert("RGB")
    few = shown.quantize(count, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.relative_to(REPOSITORY)}: {path.stat().st_size / 1000:.0f} kB")


def save(browser: Browser, name: str, colours: int = 256) -> None:
    """Save a screenshot."""
    path = PICTURES / f"{name}.png"
    browser.driver.save_screenshot(str(path))
    reduce_colours(path, colours)


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


def displaced(anchors: AnchorMap) -> AnchorMap:
    """Return the map with anchor 2 where it is not: 0.8 m from its place."""
    changed = list(anchors.anchors)
    x, y, z = changed[1].position
    changed[1] = replace(changed[1], position=(x + 0.8, y, z))
    return AnchorMap(changed)


def without_cir(record: Record) -> Record:
    return replace(record, measurement=replace(record.measurement, cir=Cir(np.zeros(0, np.int16))))


class State(NamedTuple):
    """A drive whose first screen is a picture.

    Attributes:
        building: see `FLATS`. anchors: changes the map. change: changes each record; None: it is not received.
        seconds: time in the recording.
        is_indexed: whether its tracks have been estimated. is_connected: whether its viewer still runs.
    """

    building: str = "open"
    anchors: Callable[[AnchorMap], AnchorMap] = lambda anchors: anchors
    change: Callable[[Record], Record | None] = lambda record: record
    seconds: float = 40.0
    is_indexed: bool = True
    is_connected: bool = True


STATES = {
    "good": State(),
    "anchor_off": State(anchors=displaced),
    "lost": State(change=lambda record: record if record.measurement.sequence < 700 or record.measurement.sequence > 1100 else None),
    "not_determined": State(change=lambda record: record if record.measurement.anchor_id < 3 else None),
    "without_cirs": State(change=without_cir),
    "recording": State("brick"),
    "indexing": State(is_indexed=False),
    "lost_connection": State(is_connected=False),
}  # fmt: skip


class ChangedDrive(SimulatedSource):
    """A drive whose records are changed."""

    def __init__(self, state: State) -> None:
        super().__init__(count=DRIVE_RANGES, plan=FLATS[state.building], anchors=ANCHORS + MORE_ANCHORS[:2])
        self._change = state.change

    def __iter__(self) -> Iterator[Record]:
        return filter(None, map(self._change, super().__iter__()))


def show_states(browser: Browser, folder: Path) -> None:
    """Take a picture of the first screen of each state."""
    settings = TrackSettings(height_m=0.0, offsets=OFFSET_M)
    for name, state in STATES.items():
        source, bag = ChangedDrive(state), folder / f"{name}.mcap"
        write_simulated(source, DRIVE_RANGES, 1, bag, True, None)
        anchors = state.anchors(source.anchors)
        player = BagPlayer(bag, lambda: mitigation(settings))
        player.scene.set_anchors(anchors.anchors)
        config = settings.config(anchors) if state.is_indexed else None
        player.index(config, check=displaced_anchor).join()
        player.timeline.is_complete = state.is_indexed
        view = View(player.scene, f"{name}.mcap", player=player)
        with ViewerServer(view, port=0) as server:
            browser.open(f"{server.url}#t={state.seconds}", *FIRST_SCREEN)
            browser.wait("the page", browser.ready)
            while player.position_s != state.seconds or (state.is_indexed and player.is_behind):
                time.sleep(0.1)
            time.sleep(5.0)
            if not state.is_connected:
                server.close()
                browser.wait("the message", lambda: "Connection lost" in browser.text())
            save(browser, f"state_{name}", 64)


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    parts = sys.argv[1:] or ["map", "live", "states"]
    if "map" in parts:
        plot_raw_and_corrected()
    if "live" in parts:
        show_topics()
    if "states" in parts:
        with tempfile.TemporaryDirectory() as folder, chromium() as browser:
            show_states(browser, Path(folder))


def show_topics() -> None:
    """Take pictures of the page of live topics."""
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
