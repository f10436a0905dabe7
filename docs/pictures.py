"""Makes the pictures of seeing.md and of the README: a simulated tag through driver, mitigator, locator and viewer, in Chromium.

python docs/pictures.py
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "test"))

from browser import Browser, chromium  # noqa: E402

from uwb_mitigation.nodes import processes  # noqa: E402
from uwb_mitigation.positioning.anchors import dump_anchors  # noqa: E402
from uwb_mitigation.sources.simulated import SimulatedSource  # noqa: E402

PICTURES = REPOSITORY / "docs" / "pictures"
SIMULATED_HZ = 40.0
WATCHED_S = 40.0
"""Before the page is opened: a trail, and most of a strip."""
FILLED_S = 7.0
"""Before the pictures are taken: a waterfall."""


def save(browser: Browser, name: str) -> None:
    """A picture of 256 colours, by a method that keeps rare ones."""
    path = PICTURES / f"{name}.png"
    browser.driver.save_screenshot(str(path))
    shown = Image.open(path).convert("RGB")
    few = shown.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.relative_to(REPOSITORY)}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    processes.isolate()
    PICTURES.mkdir(exist_ok=True)
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
