"""Recordings on the page: stamps that differ from log times, gaps, displaced anchors."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import START_NS, STEP_NS, corrected, record, write_corrected
from browser import Browser
from drawn import Clock, Drawn, corrected_bag
from drives import HALL, drive

from uwb_mitigation.commands.offline.track import displaced_anchor
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.recordings import recorded_ranges
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.ros import codec, topics
from uwb_mitigation.types.ros.poses import encode_true_position
from uwb_mitigation.viewer.figures import MAX_POINTS, thinned
from uwb_mitigation.viewer.headline import Positions
from uwb_mitigation.viewer.histories import Pose, Sample
from uwb_mitigation.viewer.incidents import MAX_EVENTS
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.playback import BagPlayer, Check
from uwb_mitigation.viewer.recording import add_residuals
from uwb_mitigation.viewer.scene import Scene
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
        channel = out.channel(topics.RANGE_CORRECTED, topics.RANGE_CORRECTED_TYPE)
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
                out.write_message(topics.ODOMETRY_TRUTH, topics.ODOMETRY_TYPE, place, log_ns)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive") / "drive.mcap", {7: 0.0})


def indexed(path: Path, anchors: AnchorMap = HALL, check: Check | None = None) -> View:
    """Return the view of an indexed bag, paused at its begin."""
    player = BagPlayer(path, lambda: pytest.fail("the bag contains corrected ranges"))
    player.index(EstimatorConfig(anchors), check=check).join()
    return View(player.scene, player=player)


@pytest.mark.parametrize("delay_s", [0.0, -2.0])
def test_marks_and_map_agree_with_the_log_time(bag: Path, tmp_path: Path, delay_s: float):
    view = indexed(write_drive(tmp_path / "late.mcap", {7: delay_s}) if delay_s else bag)
    page, player, timeline = Drawn(view), view.player, view.timeline
    assert f"last range {abs(delay_s):.1f} s old by stamp" in page.controls.verdict[3]
    assert page.controls.marks["bad"] == [pytest.approx(BAD / 25.0 / player.seconds, abs=2e-3)]
    (time_s, text), *_ = [event for event in page.controls.incidents if "largest" in event[1]]
    assert time_s == pytest.approx(BAD / 25.0, abs=0.05)
    assert text.startswith("largest error of a range, 3.")
    assert "BAD_CIR" not in page.column("pairs", "status")
    page.send("seek", time_s)
    assert page.controls.player["position"] == pytest.approx(time_s, abs=1e-3)
    assert "BAD_CIR" in page.column("pairs", "status")
    assert page.column("map", "x1") != []
    true_s = timeline.tracks["tag_7", TrackKind.TRUE].columns.received_s
    assert np.abs(true_s - np.arange(1000) / 25.0).max() < 0.1
    assert float(page.cards()["Position RMSE, whole recording"][0].split()[0]) < 0.5


def test_clocks_of_two_tags_may_differ_by_an_hour(tmp_path: Path):
    page = Drawn(indexed(write_drive(tmp_path / "two.mcap", {7: 0.0, 8: 3600.0})))
    page.send("seek", 30.0)
    page.send("select", "1", "8")
    assert len(page.column("pairs", "tag")) == 10
    assert len(page.column("strip", "raw")) > 140


def test_tag_that_never_has_a_position_is_named_and_the_player_runs(browser: Browser, tmp_path: Path):
    def send(name: str, *arguments: object) -> None:
        """Send a command of the page."""
        script = "Bokeh.documents[0].get_model_by_name('controls').command = [arguments[0], arguments[1], Math.random()]"
        browser.run(script, name, list(arguments))

    anchor, two = HALL.anchors[0].id, write_drive(tmp_path / "two.mcap", {7: 0.0, 9: 0.0}, lonely_tag=9)
    with ViewerServer(indexed(two), port=0) as server:
        browser.open(f"{server.url}#t=30&anchor={anchor}&tag=9")
        browser.wait("its verdict", lambda: "Position of tag 9 not determined" in browser.text())
        browser.wait(
            "its row", lambda: "no position" in [row["position age"] for row in browser.table("Tags")]
        )
        browser.run("$('events').querySelector('li:last-child button').click()")
        browser.wait("the event", lambda: abs(float(browser.run("return $('position').value")) - 30.0) > 1.0)
        send("select", anchor, 7)
        browser.wait("the other tag", lambda: "Position RMSE, whole recording" in browser.cards())
        browser.wait("its errors", lambda: len(browser.column("positions", "error")) > 100)
        browser.wait("its residuals", lambda: any(browser.column("history", "residual")))
        assert browser.console_messages() == []


def test_anchor_that_is_not_where_the_file_says_is_named_first(bag: Path):
    anchors = [replace(one, position=(11.2, 0.0, 0.5)) if one.id == 2 else one for one in HALL.anchors]
    page = Drawn(indexed(bag, AnchorMap(anchors), displaced_anchor))
    page.send("seek", 30.0)
    assert page.controls.verdict[:2] == ["degraded", "Anchor 2 is not where the anchors file says"]
    assert "2 \u2297 file" in page.column("map", "label")
    map_layers = page.document.get_model_by_name("map").renderers
    marks = next(layer.data_source.data for layer in map_layers if "file_x" in layer.data_source.data)
    fits = list(zip(marks["x"], marks["y"], strict=True))
    assert fits == [pytest.approx(HALL.anchors[1].position[:2], abs=0.2)]
    assert (marks["name"], marks["file_x"]) == (["2 ranges fit"], [11.2])
    text = next(row[-1] for row in page.controls.health if row[1] == "2")
    moved_m = math.dist(fits[0], anchors[1].position[:2])
    assert f"its ranges fit x = {fits[0][0]:.2f}, y = {fits[0][1]:.2f} m, {moved_m:.1f} m away." in text
    states = {row[1]: row[0] for row in page.controls.health}
    assert states.pop("2") == health.BAD
    assert set(states.values()) == {health.UNKNOWN}, "their residuals are relative to a track that it bends"
    assert {row[4] for row in page.controls.health} == {"-"}
    assert {row[-1] for row in page.controls.health if row[1] != "2"} == {"Not judged: see anchor 2."}


def test_gaps_are_shown_as_gaps(tmp_path: Path):
    page = Drawn(indexed(write_drive(tmp_path / "gap.mcap", {7: -2.0}, gap_s=(10.0, 30.0))))
    page.send("seek", 25.0)
    assert page.controls.tag_rows[0][4] == "no data for 15 s"
    assert np.isnan(page.column("positions", "error")).sum() == 1
    events = [(round(time_s, -1), text) for time_s, text in page.controls.incidents if "largest" not in text]
    assert sorted(events) == [
        (10.0, "position of tag 7: lost"),
        (10.0, "tag 7: lost"),
        (30.0, "position of tag 7: back after 20 s"),
        (30.0, "tag 7: back after 20 s"),
    ]
    page.send("seek", 35.0)
    assert np.isnan(page.column("strip", "raw")).sum() == 1


def test_index_reads_all_ranges(bag: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorded_ranges, "CHUNK", 100)
    whole = indexed(bag).all_data
    assert (whole.corrected, whole.ranges, whole.faults) == (999, 1000, 1)
    assert all(np.isfinite(history.columns.true_m).all() for history in whole.pairs.values())
    assert len(whole.pairs[1, 7].rows) == 200


def test_truths_and_levels_may_follow_all_ranges_and_have_no_samples(tmp_path: Path):
    count = 1200
    items = [record(number) for number in range(count)]
    with BagWriter(tmp_path / "late.mcap", {}) as out:
        for number, item in enumerate(items):
            write_corrected(out, item.measurement, corrected(number))
        for item in items:
            cir = replace(item.measurement.cir, samples=np.zeros(0, np.int16))
            measurement = replace(item.measurement, cir=cir)
            log_ns = START_NS + count * STEP_NS
            out.write_message(
                topics.RANGE_RAW, topics.RANGE_CIR_TYPE, codec.encode_range(measurement), log_ns
            )
            out.write_message(
                topics.RANGE_TRUTH,
                topics.RANGE_TRUTH_TYPE,
                codec.encode_truth(measurement, item.truth),
                log_ns,
            )
    whole = indexed(tmp_path / "late.mcap").all_data
    assert whole.errors == count
    for (anchor, _), history in whole.pairs.items():
        columns = history.columns
        assert columns.true_m.tolist() == [4.0 + number for number in range(anchor - 1, count, 2)]
        assert set(columns.gap_db) == {3.75}
        assert set(columns.rx_dbm) == {-79.5}


def test_residual_belongs_to_the_anchor_of_its_range():
    anchors = AnchorMap([Anchor(9, (0.0, 0.0, 0.0)), Anchor(3, (10.0, 0.0, 0.0))])
    scene = Scene(lambda: 0.0, is_whole=True)
    for anchor, stamp_s in ((9, 1.0), (5, 1.1), (3, 1.2), (9, 6.0), (11, 6.1)):
        scene.add_sample((anchor, 7), Sample(stamp_s, 6.5, 6.5, 0.1, Status.OK))
    for stamp_s in (0.0, 1.5):
        scene.add_pose("tag_7", Pose(4.0, 0.0, math.nan, stamp_s=stamp_s, sd_m=0.1))
    add_residuals(scene, anchors)
    residuals_m = {
        anchor: history.columns.residual_m.tolist() for (anchor, _), history in scene.pairs.items()
    }
    expected = {9: [6.5 - 4.0, math.nan], 5: [math.nan], 3: [6.5 - 6.0], 11: [math.nan]}
    for anchor, expected_m in expected.items():
        assert residuals_m[anchor] == pytest.approx(expected_m, nan_ok=True), "unknown anchor, old position"


def test_residuals_of_recorded_poses_are_those_of_the_antenna():
    scene = Scene(lambda: 0.0, is_whole=True)
    scene.add_sample((3, 7), Sample(1.0, 6.5, 6.5, 0.1, Status.OK))
    for stamp_s in (0.5, 1.5):
        scene.add_pose("tag_7", Pose(4.0, 0.0, 0.0, heading_rad=math.pi / 2, stamp_s=stamp_s))
    add_residuals(scene, AnchorMap([Anchor(3, (10.0, 0.0, 0.0))]), {"7": (0.0, -0.3, 0.0)})
    (residual_m,) = scene.pairs[3, 7].columns.residual_m
    assert residual_m == pytest.approx(6.5 - 5.7)


@pytest.mark.parametrize("first", [0, 3], ids=["in order", "overtaken"])
def test_true_positions_that_overtake_each_other_are_compared_by_their_stamps(first: int):
    scene = Scene(Clock(), is_whole=True)
    for number in range(100):
        scene.add_pose("tag_7", Pose(math.sin(number), 0.0, 0.0, stamp_s=number / 10, sd_m=0.1))
        number ^= first
        scene.add_pose(
            "tag_7", Pose(math.sin(number), 0.5, 0.0, stamp_s=number / 10, sd_m=0.1), TrackKind.TRUE
        )
    assert np.nanmax(np.abs(Positions(View(scene), 7).errors(TrackKind.CORRECTED)[:, 1] - 0.5)) < 1e-6


def test_thinned_line_is_interrupted_only_by_gaps():
    time_s = np.arange(4.0 * MAX_POINTS)
    time_s[1000:] += 60.0
    line = thinned(np.column_stack([time_s, time_s]), 3.0)
    assert len(line) == MAX_POINTS + 1
    assert np.isnan(line[:, 1]).sum() == 1


def test_recording_without_cirs_has_no_bad_ranges_and_says_what_is_missing(tmp_path: Path):
    page = Drawn(indexed(corrected_bag(tmp_path / "radio.mcap", range(60), status=Status.NO_CIR)))
    assert (page.controls.marks["bad"], page.controls.marks["faults"]) == ([], 0)
    page.send("seek", 1.0)
    assert page.controls.empty["cir"].startswith("No CIRs: the source sends none")
    assert page.cards()["Correction, whole recording"] == ("none", "the radio sends no CIRs")
    assert np.isnan(page.column("pairs", "nlos")).all()


def test_latest_events_of_a_recording_are_shown_and_the_others_counted(bag: Path):
    view = indexed(bag)
    hidden, (largest,) = view.all_data.incidents.count + 10, view.all_data.incidents.largest_error
    for number in reversed(range(MAX_EVENTS + 10)):
        view.all_data.incidents.add(100.0 + number, str(number))
    controls = Drawn(view).controls
    first, *shown = controls.incidents
    assert first == (None, f"{hidden} earlier events are not shown")
    assert shown == [largest, *((100.0 + number, str(number)) for number in range(10, MAX_EVENTS + 10))]
    assert (len(controls.marks["incidents"]), controls.marks["events"]) == (
        MAX_EVENTS + 1,
        hidden + MAX_EVENTS + 1,
    )


def test_strip_shows_the_minute_before_the_position(tmp_path: Path):
    path = corrected_bag(tmp_path / "long.mcap", range(9000), range_m=5.0, range_raw_m=5.3)
    player = BagPlayer(path, lambda: None)
    page = Drawn(View(player.scene, player=player))
    assert page.controls.cards == [["Reading the recording ...", "", ""]]
    assert page.controls.verdict[:2] == ["no data yet", "the recording is being read"]
    player.index(None).join()
    page.send("seek", player.seconds)
    assert {len(history.rows) for history in player.scene.pairs.values()} <= {3000, 3001}
    assert np.nanmin(page.column("strip", "age")) == pytest.approx(-60.0, abs=60.0 * STEP_NS / 1e7)
    assert np.ptp(page.column("history", "age")) == pytest.approx(player.seconds, abs=1.0)
