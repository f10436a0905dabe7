"""Playback of bags in the viewer, and the command in a real browser."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_material import START_NS, STEP_NS, corrected, record, write_bag, write_corrected
from browser import Browser
from command_line import run
from drawn import Drawn, corrected_bag
from drives import HALL, drive

from uwb_mitigation.commands.offline.process import Job, process_bag
from uwb_mitigation.errors import ModelError, RecordingError, UwbMitigationError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.recordings.bag.anchor_markers import write_anchors
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import Anchor, AnchorMap, anchors_path, dump_anchors, load_anchors
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import encode_range
from uwb_mitigation.types.ros.poses import encode_pose, encode_true_position, tag_topic
from uwb_mitigation.types.tracks import Estimate
from uwb_mitigation.viewer import texts
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.headline import WHOLE, cards
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.report import write_report
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

COUNT = 400
"""Number of ranges in the bag, at intervals of 10 ms, from two anchors in turn."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag with corrected ranges and their truth, poses of two tags, and the true positions of one."""
    path = tmp_path_factory.mktemp("view") / "site.mcap"
    with BagWriter(path, {"source": "a test", "simulated": "true"}) as out:
        for number in range(COUNT):
            item = record(number)
            out.write(item)
            write_corrected(out, item.measurement, corrected(number))
            if number % 10 == 0:
                stamp_ns = item.measurement.stamp_ns
                place = Estimate(stamp_ns, np.array([number / 100, 1.0, 0.0]), np.zeros(3), np.eye(6) * 0.01)
                out.write_message(topics.POSE, topics.POSE_TYPE, encode_pose(place), stamp_ns)
                out.write_message(tag_topic(topics.POSE, 9), topics.POSE_TYPE, encode_pose(place), stamp_ns)
                true = encode_true_position((number / 100, 1.5, 0.0), 7, stamp_ns)
                out.write_message(topics.ODOMETRY_TRUTH, topics.ODOMETRY_TYPE, true, stamp_ns)
    anchors = "anchors:\n  - {id: 1, x: 0, y: 0, z: 2}\n  - {id: 2, x: 5, y: 0, z: 2}\n"
    path.with_name("site.anchors.yaml").write_text(anchors)
    return path


def open_bag(
    path: Path, anchors: AnchorMap | None = None, namespace: str | None = None, **options: Any
) -> tuple[BagPlayer, Scene]:
    """Return the player of a bag that has been read, and its scene."""
    player = BagPlayer(path, lambda: Mitigation(load_bundle(default_model_path())), namespace)
    player.index(None if anchors is None else EstimatorConfig(anchors), **options).join()
    return player, player.scene


def latest(scene: Scene) -> dict[tuple[int, int], float]:
    return {pair: sample.corrected_m for pair, _, sample in scene.latest()}


def test_seek_shows_data_up_to_the_position(bag: Path):
    player, scene = open_bag(bag)
    assert player.seconds == pytest.approx((COUNT - 1) * STEP_NS / 1e9)
    for last in (399, 100, 250, 0):
        player.seek(last * STEP_NS / 1e9)
        before = last - 1
        expected = {(1 + number % 2, 7): 4.25 + number for number in (before, last) if number >= 0}
        assert latest(scene) == expected
        assert scene.now_s(7) == pytest.approx((START_NS + last * STEP_NS) / 1e9)
        assert {key: len(track.rows) for key, track in scene.tracks.items()} == {
            ("tag", TrackKind.CORRECTED): last // 10 + 1,
            ("tag_9", TrackKind.CORRECTED): last // 10 + 1,
            ("tag_7", TrackKind.TRUE): last // 10 + 1,
        }
    assert player.read_cir((2, 7)) is None
    assert player.read_cir((1, 7)).samples.tolist() == record(0).measurement.cir.samples.tolist()
    assert player.timeline.errors == COUNT, "the truth is joined, and nothing is counted twice"


def test_anchors_of_a_file_replace_those_of_the_bag(bag: Path, tmp_path: Path):
    path = tmp_path / "anchors.mcap"
    with BagWriter(path, {"source": "a test", "simulated": "true"}) as out:
        write_anchors(out, load_anchors(anchors_path(bag)), START_NS)
        for number in range(10):
            out.write(record(number))
    assert open_bag(path)[1].anchors[1].position == (0.0, 0.0, 2.0)
    player, scene = open_bag(path, AnchorMap([Anchor(1, (5.0, 5.0, 7.5))]))
    player.seek(0.05)
    assert scene.anchors[1].position == (5.0, 5.0, 7.5)


def test_recording_plays_in_real_time(bag: Path, monkeypatch: pytest.MonkeyPatch):
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    player, scene = open_bag(bag)
    player.play(True)
    now_s[0] += 0.5
    player.advance()
    assert player.position_s == pytest.approx(0.5)
    assert latest(scene) == {(2, 7): 4.25 + 49, (1, 7): 4.25 + 50}
    player.play(False)
    now_s[0] += 0.5
    player.advance()
    assert player.position_s == pytest.approx(0.5)
    player.play(True)
    for _ in range(8):
        now_s[0] += 0.5
        player.advance()
    assert (player.position_s, player.playing) == (player.seconds, False)
    assert latest(scene)[2, 7] == 4.25 + COUNT - 1
    player.play(True)
    assert player.position_s == 0.0
    player.command("speed", 5.0)
    now_s[0] += 0.5
    player.advance()
    assert player.position_s == pytest.approx(2.5)


def test_raw_ranges_are_corrected_for_display_as_in_a_processed_bag(tmp_path: Path):
    """The truth follows the corrected ranges."""
    raw = write_bag(tmp_path / "raw.mcap", 150)
    process_bag(Job(raw, tmp_path / "out.mcap", default_model_path()))
    for path in (raw, tmp_path / "out.mcap"):
        player, scene = open_bag(path)
        assert player.corrects == (path == raw)
        player.seek(player.seconds)
        assert player.timeline.errors == 150
        assert scene.pairs[1, 7].columns.true_m.tolist() == [4.0 + n for n in range(0, 150, 2)]
        expected = Mitigation(load_bundle(default_model_path())).correct([record(149).measurement])[0].range_m
        assert latest(scene)[2, 7] == pytest.approx(expected)


def test_output_of_track_is_shown(tmp_path: Path):
    ranges, truth = drive(seconds=20)
    bag, track = tmp_path / "hall.mcap", tmp_path / "track.mcap"
    with BagWriter(bag, {}) as out:
        for i in range(len(ranges)):
            anchor = HALL.anchors[ranges.anchor[i]].id
            stamp_ns, range_m = int(ranges.stamp_ns[i]), float(ranges.range_m[i])
            for tag in (7, 0x1122334455667788):
                cir = Cir(np.zeros(0, np.int16))
                out.write(Record(RangeMeasurement(stamp_ns, tag, anchor, i, 0, range_m, cir)))
    anchors_path(bag).write_text(dump_anchors(HALL))
    processed = tmp_path / "processed.mcap"
    for command in (("process", bag, "-o", processed), ("track", processed, "-o", track, "--height", "1.0")):
        done = run(*command, folder=tmp_path)
        assert done.returncode == 0, done.stderr
    assert not anchors_path(processed).exists(), "the anchors are in the bag"
    _, processed_scene = open_bag(processed)
    assert sorted(processed_scene.anchors) == sorted(HALL.index)
    player, scene = open_bag(track)
    player.seek(player.seconds)
    assert {kind for _, kind in scene.tracks} >= {TrackKind.CORRECTED, TrackKind.SMOOTHED}
    assert {name for name, kind in scene.tracks if kind is TrackKind.SMOOTHED} == set(scene.tags)
    assert any("0x1122334455667788" in name for name in scene.tags)
    for view in scene.tracks.values():
        assert view.rows[-1, :2] == pytest.approx(truth.position[-1, :2], abs=0.5)
    assert "without ranges" in scene.missing["ranges"]
    written = load_anchors(anchors_path(track)).anchors
    assert [(anchor.id, anchor.position) for anchor in written] == [(a.id, a.position) for a in HALL.anchors]


def test_recording_is_shown_as_far_as_it_has_been_read(bag: Path):
    player, scene = open_bag(bag)
    player.seek(3.0)
    player.play(True)
    player.timeline.read_s = 2.0
    player.advance()
    assert player.is_behind
    assert player.shown_s == scene.clock() == 2.0, "the slider shows the time of the map"
    assert latest(scene) == {(1, 7): 4.25 + 200, (2, 7): 4.25 + 199}
    player.timeline.read_s = player.seconds
    player.advance()
    assert latest(scene) == {(1, 7): 4.25 + 300, (2, 7): 4.25 + 299}


def test_truncated_bag_is_shown_up_to_the_damage(bag: Path, tmp_path: Path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(write_bag(tmp_path / "whole.mcap", 3000).read_bytes()[:-20_000])
    player, scene = open_bag(cut)
    player.seek(player.seconds)
    player.seek(0.0)
    assert latest(scene)
    assert "nothing beyond can be shown" in Drawn(View(scene, player=player)).controls.notice[-1]


def test_anchor_id_above_64_bits_is_ignored() -> None:
    scene = Scene()
    pose = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=3.0))
    texts = "1" * 5000, str(2**64 - 1)
    SceneUpdater(scene).markers(
        SimpleNamespace(markers=[SimpleNamespace(ns="anchors", id=0, text=text, pose=pose) for text in texts])
    )
    assert list(scene.anchors) == [2**64 - 1]


def test_implausible_values_of_standard_messages_are_ignored() -> None:
    scene = Scene()
    feed = SceneUpdater(scene)
    for covariance in (1.7e308, float("inf"), float("nan"), -1.0):
        pose = SimpleNamespace(
            position=SimpleNamespace(x=1.0, y=2.0, z=float("nan")),
            orientation=SimpleNamespace(x=0.0, y=0.0, z=1e300, w=1e300),
        )
        header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0))
        message = SimpleNamespace(
            header=header, pose=SimpleNamespace(pose=pose, covariance=[covariance] * 36)
        )
        feed.add(topics.POSE, message)
        assert np.isnan(scene.tags["tag"][3:6]).all()
    feed.add_encoded(topics.RANGE_RAW, b"")
    assert feed.malformed == 1


def test_bag_without_ranges_and_tracks_is_refused(tmp_path: Path):
    path = tmp_path / "one.mcap"
    with BagWriter(path, {}) as out:
        out.write_message(
            topics.ODOMETRY_TRUTH,
            topics.ODOMETRY_TYPE,
            encode_true_position((0.0, 0.0, 0.0), 1, START_NS),
            START_NS,
        )
    with pytest.raises(RecordingError, match="no ranges and no tracks"):
        open_bag(path)


def test_raw_ranges_of_a_pair_without_corrected_ones_are_skipped(tmp_path: Path):
    path = tmp_path / "some.mcap"
    with BagWriter(path, {}) as out:
        for number in range(40):
            out.write(record(number))
            if number % 2 == 0:
                write_corrected(out, record(number).measurement, corrected(number))
    player, scene = open_bag(path, HALL)
    player.seek(player.seconds)
    assert player.timeline.is_complete
    assert list(latest(scene)) == [(1, 7)]


def test_several_namespaces_need_a_choice(tmp_path: Path):
    path = tmp_path / "two.mcap"
    with BagWriter(path, {}) as out:
        for number in range(4):
            data = encode_range(record(number).measurement)
            for board in ("left", "right"):
                out.write_message(f"/{board}/uwb/range_raw", topics.RANGE_CIR_TYPE, data, START_NS + number)
    with pytest.raises(UwbMitigationError, match="--namespace with one of: '/left', '/right'"):
        open_bag(path)
    player, _ = open_bag(path, namespace="/left")
    player.seek(1.0)
    assert player.timeline.ranges == 4


def test_index_of_a_drive_has_tracks_errors_and_residuals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bag = tmp_path / "flat.mcap"
    done = run("data", "simulate", "--like", "drive", "--ranges", "400", "-o", bag, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    anchors = load_anchors(anchors_path(bag))
    player, scene = open_bag(bag, anchors)
    timeline = whole = player.timeline
    assert whole.ranges == sum(1 for _ in BagReader(bag).messages([topics.RANGE_RAW]))
    figures = {title: (value, text) for title, value, text in cards(View(scene, player=player), 101)}
    corrected, references = figures["Position RMSE, whole recording"]
    assert float(corrected.split()[0]) < 0.8 * float(re.search(r"raw \+ same filter: (\S+) m", references)[1])
    counted: list[str] = []
    monkeypatch.setattr(texts, "cards", lambda *_: counted.append(WHOLE) or [])
    page = Drawn(View(scene, player=player))
    for position_s in (5.0, 8.0):
        page.send("seek", position_s)
    assert counted == [WHOLE], "a seek in a long recording must not compute its figures again"
    assert whole.error_sums_m[1] < whole.error_sums_m[0]
    ranges = whole.pairs[1, 101].columns
    assert np.isfinite(ranges.residual_m).mean() > 0.9, "of the whole recording"
    assert np.isfinite(ranges.gap_db).all()
    assert np.ptp(page.column("history", "age")) > 0.9 * player.seconds
    assert np.nanmean(page.column("positions", "error")) < np.nanmean(page.column("positions", "raw"))
    player.seek(player.seconds)
    assert set(scene.tracks) == set(whole.tracks)
    shown = (of.tracks["tag_101", TrackKind.CORRECTED].rows[-1] for of in (scene, whole))
    assert np.array_equal(*shown, equal_nan=True)
    assert "tag_101" in scene.tags
    assert np.nanmax(np.abs(page.column("pairs", "residual"))) < 1.0, "of the minute before the position"
    again, _ = open_bag(bag, anchors, estimated=list(timeline.estimates.values()))
    assert again.timeline.estimates == timeline.estimates, "known tracks are not estimated again"


def test_failed_correction_is_raised_and_shown(tmp_path: Path):
    def fail(*_: object) -> None:
        raise ModelError("broken", where="model.json")

    path = write_bag(tmp_path / "raw.mcap")
    with pytest.raises(ModelError, match=r"model\.json"):
        BagPlayer(path, fail).index(None)
    failing = SimpleNamespace(correct=fail, used={})
    with pytest.raises(ModelError, match=r"model\.json"):
        write_report(tmp_path / "report.html", path, EstimatorConfig(HALL), lambda: failing, [], {})
    player = BagPlayer(path, lambda: failing)
    player.index(None).join()
    page = Drawn(View(player.scene, player=player))
    assert "Reading stopped: ModelError: " in " ".join(page.controls.notice)


@pytest.mark.parametrize("count", [1, 40])
def test_tag_without_a_position_does_not_stop_the_player(tmp_path: Path, count: int):
    player, scene = open_bag(corrected_bag(tmp_path / "one_anchor.mcap", range(0, 2 * count, 2)), HALL)
    player.play(True)
    player.seek(player.seconds)
    assert latest(scene) == {(1, 7): 4.25 + 2 * count - 2}
    assert "1 anchors received, 3 or more needed" in player.timeline.notices[0]


@contextmanager
def serve_recording(bag: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `uwb-mitigation view` on a bag; return the URL."""
    command = [
        sys.executable,
        "-c",
        "from uwb_mitigation.commands.entry import command_line; command_line()",
        "view",
    ]
    running = subprocess.Popen(
        [*command, str(bag), "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        first_line = running.stdout.readline()
        found = re.search(r"http://\S+", first_line)
        assert found is not None, first_line + running.stdout.read()
        yield running, found[0]
    finally:
        running.kill()
        running.wait()


def test_slider_can_be_dragged_during_playback(browser: Browser, tmp_path: Path):
    from selenium.webdriver.common.action_chains import ActionChains

    def position() -> float:
        return float(slider.get_property("value"))

    player, scene = open_bag(corrected_bag(tmp_path / "long.mcap", range(0, 30_000, 100)))
    with ViewerServer(View(scene, player=player), port=0) as server:
        player.play(True)
        browser.open(server.url)
        slider = browser.wait("the slider", lambda: browser.find("slider", "Time in the recording, s"))
        browser.wait("it to play", lambda: position() > 0)
        box = slider.rect

        def at(time_s: float) -> tuple[int, int]:
            # The thumb is 16 pixels wide and stays inside of the slider.
            x = box["x"] + 8 + (box["width"] - 16) * time_s / float(slider.get_property("max"))
            return round(x), round(box["y"] + box["height"] / 2)

        actions = ActionChains(browser.driver, duration=100)
        mouse = actions.w3c_actions.pointer_action
        mouse.move_to_location(*at(position())).pointer_down()
        mouse.move_to_location(*at(250.0)).pause(1.0).move_to_location(*at(200.0)).pause(1.0)
        actions.perform()
        assert position() == pytest.approx(200.0, abs=2.0), "it stays where it is held"
        actions = ActionChains(browser.driver)
        actions.w3c_actions.pointer_action.pointer_up()
        actions.perform()
        browser.wait("it to play from there", lambda: position() > 203.0)
        assert position() < 250.0


def test_recording_plays_on_the_page(browser: Browser, bag: Path):
    def ranges() -> list[float]:
        return sorted(browser.column("pairs", "corrected"))

    with serve_recording(bag) as (running, url):
        browser.open(url + "#anchor=2&tag=7&t=1.0")
        browser.wait("the position of the URL", lambda: ranges() == [4.25 + 99, 4.25 + 100])
        assert browser.find("heading", "Range, last 60 s: anchor 2, tag 7")
        browser.click("button", "0.0 s: largest error of a range, 0.25 m: anchor 1, tag 7")
        browser.wait("the first range: all have the same error", lambda: ranges() == [4.25])
        browser.wait("the time in the URL", lambda: "t=0.00" in browser.driver.current_url)
        browser.find("combobox", "speed").send_keys("50x")
        browser.click("button", "Play")
        browser.wait(
            "it to play to its end", lambda: browser.find("button", "Play") and ranges()[-1] == 4.25 + 399
        )
        assert browser.console_messages() == []
        browser.resize(400, 2000)
        # Figures change their width asynchronously.
        browser.wait("it to fit", lambda: browser.run("return document.documentElement.scrollWidth") <= 400)
        running.send_signal(signal.SIGINT)
        assert running.wait(240) == 130
