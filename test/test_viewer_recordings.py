"""Recordings whose stamps differ from their log times, and clients that are slow, in a real browser."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import START_NS, corrected, record
from browser import Browser
from drives import HALL, drive

from uwb_mitigation.commands.offline.track import displaced_anchor
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.recordings import recorded_ranges
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.ros import codec
from uwb_mitigation.types.ros.poses import encode_true_position
from uwb_mitigation.types.ros.topics import ODOMETRY_TRUTH, ODOMETRY_TYPE
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.histories import Sample
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.scene import Pose, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

BAD = 700
"""Row of the range whose status is not OK and whose error is the largest."""


def write_drive(
    path: Path,
    delays_s: dict[int, float],
    latency_s: float = 0.05,
    gap_s: tuple[float, float] = (0.0, 0.0),
    lonely_tag: int | None = None,
) -> Path:
    """Write a drive of 40 s with corrected ranges, their truth, and true positions.

    Args:
        path: the bag.
        delays_s: {tag: what its clock shows more than the clock of the recorder}.
        latency_s: time from a range to its log time.
        gap_s: interval without ranges.
        lonely_tag: receives only the first anchor.
    """
    ranges, truth = drive(seconds=40.0, rate_hz=25.0)
    with BagWriter(path, {}) as out:
        channel = out.corrected_channel()
        for tag, delay_s in delays_s.items():
            for row in range(len(ranges)):
                time_s = ranges.stamp_ns[row] / 1e9
                if gap_s[0] < time_s < gap_s[1] or (tag == lonely_tag and ranges.anchor[row]):
                    continue
                log_ns = START_NS + int(ranges.stamp_ns[row]) + int(latency_s * 1e9)
                stamp_ns = START_NS + int(ranges.stamp_ns[row]) + int(delay_s * 1e9)
                range_m = float(ranges.range_m[row]) + 3.0 * (row == BAD)
                item = record(row)
                anchor = HALL.anchors[ranges.anchor[row]].id
                measurement = replace(item.measurement, stamp_ns=stamp_ns, anchor_id=anchor, tag_id=tag)
                status = Status.BAD_CIR if row == BAD else Status.OK
                result = replace(corrected(row), range_m=range_m, range_raw_m=range_m + 0.4, status=status)
                out.write_serialized(
                    channel, codec.encode_corrected(measurement, result), log_ns, log_ns, row
                )
                distance_m = float(np.linalg.norm(truth.position[row] - HALL.position[ranges.anchor[row]]))
                true_range = codec.encode_truth(measurement, replace(item.truth, range_m=distance_m))
                out.write_message(
                    "/uwb/range_truth", "uwb_mitigation_msgs/msg/RangeTruth", true_range, log_ns
                )
                place = encode_true_position(tuple(truth.position[row].tolist()), tag, stamp_ns)
                out.write_message(ODOMETRY_TRUTH, ODOMETRY_TYPE, place, log_ns)
    return path


@contextmanager
def serve(path: Path, anchors: AnchorMap = HALL) -> Iterator[tuple[BagPlayer, ViewerServer]]:
    """Serve an indexed bag, paused at its begin."""
    lock = threading.Lock()
    feed = SceneUpdater(Scene(), lock)
    player = BagPlayer(path, feed, lambda: pytest.fail("the bag contains corrected ranges"))
    feed.anchors(anchors)
    player.index(EstimatorConfig(anchors), check=displaced_anchor).join()
    with ViewerServer(View(feed.scene, lock, player=player), port=0) as server:
        yield player, server


def send(browser: Browser, name: str, *arguments: object) -> None:
    """Send a command of the page."""
    script = "Bokeh.documents[0].get_model_by_name('controls').command = [arguments[0], arguments[1], Math.random()]"
    browser.run(script, name, list(arguments))


def position_s(browser: Browser) -> float:
    return float(browser.run("return document.getElementById('position').value"))


@pytest.mark.parametrize("delay_s", [0.0, -2.0])
def test_marks_and_map_agree_with_the_log_time(browser: Browser, tmp_path: Path, delay_s: float):
    with serve(write_drive(tmp_path / "drive.mcap", {7: delay_s})) as (player, server):
        browser.open(server.url)
        browser.wait("the figures", lambda: "Position RMSE, whole recording" in browser.cards())
        assert ("Stamps differ from the log time" in browser.text()) == (delay_s != 0.0)
        for button in ("Largest error", "Next bad range", "Previous bad range"):
            if button != "Largest error":
                send(browser, "seek", 0.0 if button == "Next bad range" else 40.0)
                browser.wait("the other position", lambda: abs(position_s(browser) - BAD / 25.0) > 1.0)
            browser.click("button", button)
            browser.wait(button, lambda: position_s(browser) == pytest.approx(BAD / 25.0, abs=0.05))
            browser.wait("its status", lambda: "BAD_CIR" in browser.column("pairs", "status"))
        browser.wait(
            "the track",
            lambda: browser.column("map", "heading") == [None] and "tag 7" in browser.column("map", "name"),
        )
        assert player.timeline is not None
        assert (
            np.abs(player.timeline.tracks["tag_7", TrackKind.TRUE][:, 0] - np.arange(1000) / 25.0).max() < 0.1
        )
        assert float(browser.cards()["Position RMSE, whole recording"][0].split()[0]) < 0.5
        assert browser.console_messages() == []


def test_clocks_of_two_tags_may_differ_by_an_hour(browser: Browser, tmp_path: Path):
    with serve(write_drive(tmp_path / "two.mcap", {7: 0.0, 8: 3600.0})) as (_, server):
        browser.open(server.url + "#t=30&anchor=1&tag=8")
        browser.wait("pairs of both tags", lambda: len(browser.column("pairs", "tag")) == 10)
        browser.wait("a full strip", lambda: len(browser.column("strip", "raw")) > 140)


def test_tag_that_never_has_a_position_is_named_and_the_player_runs(browser: Browser, tmp_path: Path):
    anchor, bag = HALL.anchors[0].id, write_drive(tmp_path / "two.mcap", {7: 0.0, 9: 0.0}, lonely_tag=9)
    with serve(bag) as (_, server):
        browser.open(f"{server.url}#t=30&anchor={anchor}&tag=9")
        browser.wait("its verdict", lambda: "Position not determined" in browser.text())
        browser.wait("its row", lambda: "no position" in [row["age"] for row in browser.table("Tags")])
        send(browser, "seek", 10.0)
        browser.wait("the other position", lambda: position_s(browser) == 10.0)
        send(browser, "select", anchor, 7)
        browser.wait("the other tag", lambda: "Position RMSE, whole recording" in browser.cards())
        browser.wait("its errors", lambda: len(browser.column("positions", "error")) > 100)
        browser.wait("its residuals", lambda: any(browser.column("history", "residual")))
        assert browser.console_messages() == []


def test_anchor_that_is_not_where_the_file_says_is_named_first(browser: Browser, tmp_path: Path):
    anchors = [replace(one, position=(11.2, 0.0, 0.5)) if one.id == 2 else one for one in HALL.anchors]
    with serve(write_drive(tmp_path / "drive.mcap", {7: 0.0}), AnchorMap(anchors)) as (_, server):
        browser.open(server.url + "#t=30", 1280, 720)
        browser.wait("the verdict", lambda: "Anchor 2 is not where the anchors file says" in browser.text())
        browser.wait("the marker", lambda: "2 \u2297 not here" in browser.column("map", "text"))
        assert [row["state"] for row in browser.table("Anchors")].count(health.BAD) == 1


def test_same_url_shows_the_same_figures(browser: Browser, tmp_path: Path):
    with serve(write_drive(tmp_path / "drive.mcap", {7: 0.0})) as (player, server):
        browser.open(server.url + "#t=20")
        browser.wait("the figures", lambda: browser.cards().get("Position error, now", "-")[0] != "-")
        whole = browser.cards()
        send(browser, "seek", 0.0)
        send(browser, "speed", 50.0)
        send(browser, "play", True)
        browser.wait("the end", lambda: player.position_s == player.seconds)
        browser.find("combobox", "figures of").send_keys("last")
        browser.wait("the other figures", lambda: "Position RMSE, last 60 s" in browser.cards())
        assert "window=last" in browser.driver.current_url
        browser.open(server.url + "#t=20.0")
        browser.wait(
            "the figures", lambda: browser.cards().get("Position error, now") == whole["Position error, now"]
        )
        assert browser.cards() == whole
        assert browser.find("heading", "Range errors, whole recording")


def test_gaps_are_shown_as_gaps(browser: Browser, tmp_path: Path):
    with serve(write_drive(tmp_path / "gap.mcap", {7: -2.0}, gap_s=(10.0, 30.0))) as (_, server):
        browser.open(server.url + "#t=25")
        browser.wait(
            "an old tag", lambda: any("no data for 15 s" in name for name in browser.column("map", "name"))
        )
        assert browser.column("positions", "error").count(None) == 1
        events = [event.split(": ", 1) for event in browser.run("return $('events').innerText").splitlines()]
        assert sorted(text for _, text in events) == [
            "position of tag 7: back after 20 s", "position of tag 7: lost", "tag 7: back after 20 s", "tag 7: lost",
        ]  # fmt: skip
        assert {round(float(time_s.removesuffix(" s")) / 10.0) for time_s, _ in events} == {1, 3}
        browser.run("$('events').querySelector('li:last-child button').click()")
        browser.wait("the last event", lambda: position_s(browser) == pytest.approx(30.0, abs=0.2))
        send(browser, "seek", 35.0)
        browser.wait("a gap in the strip", lambda: None in browser.column("strip", "raw"))


def test_index_reads_all_ranges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorded_ranges, "CHUNK", 100)
    with serve(write_drive(tmp_path / "drive.mcap", {7: 0.0})) as (player, _):
        timeline = player.timeline
        assert timeline is not None
        assert (len(timeline.bad), timeline.bad.sum()) == (1000, 1)
        assert timeline.largest_error() == BAD
        assert np.isfinite(timeline.true_m).all()
        assert timeline.losses[1, 7] == (0, 200)


class SlowLink:
    """A TCP proxy that forwards at most a number of bytes per second to the client.

    Attributes:
        port: port of the proxy.
        target: port of the server, set before a client connects.
        rate: bytes per second.
    """

    def __init__(self) -> None:
        self.target, self.rate = 0, 1e9
        self._listener = socket.create_server(("localhost", 0))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.socket()
            # Small buffers: otherwise they contain data of many seconds.
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
            server.connect(("localhost", self.target))
            for source, sink, is_slow in ((client, server, False), (server, client, True)):
                threading.Thread(target=self._forward, args=(source, sink, is_slow), daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket, is_slow: bool) -> None:
        try:
            while data := source.recv(2048):
                sink.sendall(data)
                time.sleep(len(data) / self.rate if is_slow else 0.0)
        except OSError:
            pass
        finally:
            source.close()
            sink.close()

    def close(self) -> None:
        # Closing alone does not end an `accept` that waits in another thread.
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()


def test_slow_client_shows_current_data_or_its_age(browser: Browser):
    lock = threading.Lock()
    view = View(Scene(), lock)
    stop = threading.Event()

    def feed() -> None:
        while not stop.wait(0.02):
            now_s = time.time()
            with lock:
                for anchor in range(8):
                    view.scene.add_sample((anchor, 7), Sample(now_s, 5.0, now_s % 1000.0, 0.1, Status.OK))
                view.scene.add_pose("tag", Pose(math.sin(now_s), math.cos(now_s), 0.0, stamp_s=now_s))

    def age_s() -> float:
        shown = max(browser.column("pairs", "corrected"))
        return (time.time() % 1000.0 - shown) % 1000.0

    link = SlowLink()
    thread = threading.Thread(target=feed)
    with ViewerServer(view, port=0, origins=(f"localhost:{link.port}",)) as server:
        link.target = server.port
        thread.start()
        try:
            browser.open(f"http://localhost:{link.port}/")
            browser.wait("pairs", lambda: len(browser.column("pairs", "corrected")) == 8)
            link.rate = 40_000.0
            time.sleep(10.0)
            # Nothing queues: without acknowledgements, the age has grown to 10 s and grows further.
            browser.wait("current data", lambda: age_s() < 6.0)
            assert "behind" in browser.text() or "LIVE" in browser.text()
            link.rate = 500.0
            browser.wait("a page that admits its age", lambda: "s behind" in browser.text())
            link.rate = 1e9
        finally:
            stop.set()
            thread.join()
            link.close()
