"""Measure a page of the viewer: data, first paint and processor time with 30 anchors and 5 tags; seeks in a long recording.

    python docs/experiments/viewer_load.py [page] [seek]

`page`, in Chromium: every pair has the same share of 500 ranges per second. CIRs have 157 samples.
`seek`, without a browser: a recording of 600,000 ranges whose tracks have been estimated.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test"))

from bag_material import START_NS, corrected, record
from browser import Browser, chromium
from drawn import Drawn
from drives import HALL, drive

from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import Anchor
from uwb_mitigation.types.measurement import (
    Cir,
    CorrectedBy,
    CorrectedRange,
    Encoding,
    RangeMeasurement,
    Status,
)
from uwb_mitigation.types.ros.codec import MeasurementKey, encode_corrected
from uwb_mitigation.types.ros.topics import RANGE_CORRECTED, RANGE_CORRECTED_TYPE, RANGE_RAW
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.histories import Pose
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

ANCHORS, TAGS, RATE_HZ = 30, 5, 500
MEASURED_S, PERIOD_S = 20.0, 0.1
LONG, LONG_HZ, SEEKS = 600_000, 100.0, 15
"""Numbers of ranges of the long recording and of seeks."""
SHARES = 0.9, *((0.1 / (len(Status) - 1),) * (len(Status) - 1))
"""Of the statuses, the first of which is OK."""
UPDATES = "return Bokeh.documents[0].get_model_by_name('controls').timing[0]"
SCREENSHOT = Path("build") / "screens" / "viewer_30_anchors.png"


def feed_ranges(feed: SceneUpdater, stop: threading.Event) -> None:
    """Feed ranges of all pairs until `stop` is set."""
    rng = np.random.default_rng(1)
    samples = rng.integers(0, 1000, 157).astype(np.int16)
    sequence = 0
    while not stop.wait(PERIOD_S):
        for tag in range(1, TAGS + 1):
            angle = time.monotonic() / 10 + tag
            with feed.scene.lock:
                feed.scene.add_pose(
                    f"tag_{tag}",
                    Pose(
                        12 + 8 * np.cos(angle), 9 + 6 * np.sin(angle), 1.0, 0.5, 0.3, 0.2, stamp_s=time.time()
                    ),
                )
        for _ in range(int(RATE_HZ * PERIOD_S)):
            anchor, tag = 1 + sequence % ANCHORS, 1 + sequence // ANCHORS % TAGS
            key = MeasurementKey(time.time_ns(), tag, anchor, sequence)
            status = Status(rng.choice(len(Status), p=SHARES))
            raw_m = 8.0 + rng.normal()
            cir = Cir(samples, Encoding.MAGNITUDE, 745, 750.4, rx_power_dbm=-85.0, first_path_power_dbm=-89.0)
            feed.add(RANGE_RAW, RangeMeasurement(key.stamp_ns, tag, anchor, sequence, 0, raw_m, cir))
            corrected = CorrectedRange(raw_m - 0.4, raw_m, 0.4, 0.01, status, CorrectedBy.HOST, 1)
            feed.add(RANGE_CORRECTED, (key, corrected))
            sequence += 1


def load(browser: Browser, url: str) -> None:
    """Print the transferred bytes and the times of one page."""
    browser.open(url, 1280, 2000)
    began_s = time.monotonic()
    browser.wait("the page", browser.ready)
    drawn_s = time.monotonic() - began_s
    paint_ms, transferred = browser.run(
        "const paint = performance.getEntriesByName('first-contentful-paint')[0].startTime;"
        "const files = [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')];"
        "return [paint, files.reduce((sum, file) => sum + file.transferSize, 0)]"
    )
    print(
        f"transferred {transferred / 1e3:.0f} kB, first paint {paint_ms:.0f} ms, figures after {1e3 * drawn_s:.0f} ms more"
    )


def write_long(path: Path) -> None:
    """Write a recording with one tag."""
    ranges, _ = drive(seconds=LONG / LONG_HZ, rate_hz=LONG_HZ)
    with BagWriter(path, {}) as out:
        channel = out.channel(RANGE_CORRECTED, RANGE_CORRECTED_TYPE)
        for row in range(len(ranges)):
            stamp_ns, range_m = START_NS + int(ranges.stamp_ns[row]), float(ranges.range_m[row])
            anchor = HALL.anchors[ranges.anchor[row]].id
            measured = replace(record(0).measurement, stamp_ns=stamp_ns, anchor_id=anchor, sequence=row)
            result = replace(corrected(0), range_m=range_m, range_raw_m=range_m + 0.4)
            out.write_serialized(channel, encode_corrected(measured, result), stamp_ns, stamp_ns, row)


def seek() -> None:
    """Print the processor time of seeks in the long recording, each with the update of one page."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "long.mcap")
        write_long(path)
        player = BagPlayer(path, Mock())
        player.index(EstimatorConfig(HALL)).join()
        page, used_s = Drawn(View(player.scene, player=player)), []
        for position_s in np.random.default_rng(1).uniform(0.0, player.seconds, 1 + SEEKS):
            before_s = time.process_time()
            page.send("seek", position_s)
            used_s.append(time.process_time() - before_s)
    # The first one also draws the figures of the whole recording.
    print(
        f"{LONG} ranges: a seek needs {np.median(used_s[1:]):.3f} s of processor time, at most {max(used_s[1:]):.3f} s"
    )


def main() -> None:
    parts = sys.argv[1:] or ["page", "seek"]
    if "page" in parts:
        show_page()
    if "seek" in parts:
        seek()


def show_page() -> None:
    """Print the figures of a page, and save its screenshot."""
    scene = Scene()
    scene.set_anchors([Anchor(n, (4.0 * (n % 6), 4.5 * (n // 6), 2.0)) for n in range(1, ANCHORS + 1)])
    view, stop = View(scene), threading.Event()
    feed = SceneUpdater(scene)
    with ViewerServer(view, port=0) as server, chromium() as browser:
        thread = threading.Thread(target=feed_ranges, args=(feed, stop))
        thread.start()
        try:
            time.sleep(3.0)
            for _ in range(3):
                load(browser, server.url)
            process = psutil.Process()
            before_s, began_s = sum(process.cpu_times()[:2]), time.monotonic()
            updates = browser.run(UPDATES)
            time.sleep(MEASURED_S)
            used_s = sum(process.cpu_times()[:2]) - before_s
            passed_s = time.monotonic() - began_s
            print(
                f"{ANCHORS} anchors, {TAGS} tags, {RATE_HZ} ranges/s: {used_s / passed_s:.0%} of a core, "
                f"{(browser.run(UPDATES) - updates) / passed_s:.1f} updates per second"
            )
            SCREENSHOT.parent.mkdir(parents=True, exist_ok=True)
            browser.driver.save_screenshot(str(SCREENSHOT))
        finally:
            stop.set()
            thread.join()


if __name__ == "__main__":
    main()
