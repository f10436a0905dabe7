"""The same settings give the same figures in `track` and on the page of the viewer, on every data set of the tests."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from bag_material import record, without_cir, write_records
from command_line import run, succeed
from drives import HALL, drive

from benchmarks.position_data import real_runs
from uwb_mitigation.commands.offline.track import mitigation, read_config
from uwb_mitigation.commands.positioning import track
from uwb_mitigation.commands.support.options import OPTIONS
from uwb_mitigation.commands.view import view
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.tag_locator import TagLocator
from uwb_mitigation.positioning.track_settings import TrackSettings
from uwb_mitigation.recordings.bag.anchor_markers import read_anchors
from uwb_mitigation.recordings.recorded_ranges import RangeTable
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, Record, Status
from uwb_mitigation.types.offsets import read_offsets
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.viewer.headline import cards
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.state import View

HANYANG, LABYRINTH = "hanyang_outdoor/NLOS_A1", "chemnitz_labyrinth"
BOX = Area((-20.0, -60.0, -2.0), (80.0, 60.0, 4.0))


def indexed(bag: Path, settings: TrackSettings) -> BagPlayer:
    """Return the player of a bag after its index is complete."""
    player = BagPlayer(bag, lambda: mitigation(settings))
    player.index(read_config(bag, read_anchors(bag), settings), settings.stamp_offset_s).join()
    return player


@pytest.fixture(scope="module")
def imported(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Return a function that imports a recording once (empty: a simulated drive), and returns the bag."""

    @cache
    def import_once(source: str) -> Path:
        folder = tmp_path_factory.mktemp("imported")
        if source:
            name = ["--map", "labyrinth"] if source == LABYRINTH else []
            data = request.getfixturevalue("data")
            succeed("data", "import", data / source, *name, "-o", "raw.mcap", folder=folder)
        else:
            succeed("data simulate --like drive --ranges 300 -o raw.mcap", folder=folder)
        return folder / "raw.mcap"

    return import_once


SIMULATED = ("", ["--height", "0", "--odometry", "/odom", "--imu", "/imu"],
             TrackSettings(0.0, odometry="/odom", imu="/imu"))  # fmt: skip


@pytest.mark.parametrize(
    ("source", "options", "settings", "processed"),
    [
        (HANYANG, ["--stamp-offset=-0.2", "--height", "1", "--area=-20,-60,-2,80,60,4"],
         TrackSettings(1.0, area=BOX, stamp_offset_s=-0.2), False),
        (LABYRINTH, ["--height", "0", "--odometry", "/odom"], TrackSettings(0.0, odometry="/odom"), True),
        (*SIMULATED, False),
        (*SIMULATED, True),
    ],
    ids=["hanyang", "labyrinth processed", "simulated", "simulated processed"],
)  # fmt: skip
def test_track_and_view_give_the_same_figures(
    imported, tmp_path: Path, source: str, options: list[str], settings: TrackSettings, processed: bool
):
    bag = imported(source)
    if processed:
        succeed("process", bag, "-o", "processed.mcap", folder=tmp_path)
        bag = tmp_path / "processed.mcap"
    succeed("track", bag, "-o", "track.mcap", *options, "--json", "track.json", folder=tmp_path)
    result = json.loads((tmp_path / "track.json").read_text())
    player = indexed(bag, settings)
    timeline = player.timeline
    (tag,) = result["tags"]
    view = View(player.scene, player=player)
    figures = {title: (value, text) for title, value, text in cards(view, tag["tag_id"])}
    for title, key in (
        ("Position RMSE, whole recording", "horizontal_rmse_m"),
        ("95 % of position errors below, whole recording", "p95_m"),
    ):
        live, raw, smoothed = (f"{result[kind][key]:.3f} m" for kind in ("live", "raw_live", "smoothed"))
        assert figures[title] == (live, f"raw + same filter: {raw}; smoothed: {smoothed}")
        if source:
            assert live == raw, "nothing was corrected"
    shown = [notice.split(": ", 1)[1] for notice in timeline.notices]
    assert [text for text in shown if text in tag["warnings"]] == tag["warnings"]
    if source:
        value, text = figures["Ranges corrected, whole recording"]
        assert (value, "ranges: no CIRs" in text) == ("none", True)


def test_placements_have_no_positions_in_track_and_view(apartment_imported: Path, tmp_path: Path):
    bag = apartment_imported / "apartment.mcap"
    refused = run("track", bag, "-o", "track.mcap", folder=tmp_path).stderr.replace("\n", " ")
    timeline = indexed(bag, TrackSettings()).timeline
    assert not timeline.estimates
    assert any(notice in refused for notice in timeline.notices), (timeline.notices, refused)


@pytest.mark.parametrize(
    "options",
    [
        {"height_m": 1.0, "height_topic": "/height"},
        {"imu": "/imu"},
        {"stamp_offset_s": 4000.0},
        {"acceleration": -1.0},
        {"height_sd_m": math.nan},
    ],
)
def test_contradictory_settings_are_refused(options: dict[str, object]):
    with pytest.raises(ParameterError):
        TrackSettings(**options)


def test_variance_of_ranges_without_cir_is_that_of_real_errors(data: Path):
    """The mean squared error of each real drive is at most four variances."""
    corrector = Mitigation(load_bundle(default_model_path()), read_offsets("0.1"))
    for run_source in real_runs(data)[0]:
        recorded = run_source.read()
        measurements = [item.measurement for item in recorded.read_records()]
        variance_m2 = np.array([result.variance_m2 for result in corrector.correct(measurements)])
        true = recorded.truth.position_at(recorded.ranges.stamp_ns)
        error_m = recorded.ranges.range_m - np.linalg.norm(
            true - recorded.anchors.position[recorded.ranges.anchor], axis=1
        )
        assert 0.05 < np.nanmean(error_m**2 / variance_m2) < 4.0, recorded.name


def test_stamps_in_another_unit_are_reported():
    ranges, _ = drive(seconds=8)
    locator = TagLocator(HALL, height_m=1.0)
    for row in range(len(ranges)):
        locator.add(replace(without_cir(ranges, row), stamp_ns=row))
    assert "stamps must be nanoseconds" in locator.warnings()[0]


def test_radio_without_cirs_is_located_live_as_from_raw_ranges():
    ranges, _ = drive(seconds=8)
    raw, passed, mixed = (TagLocator(HALL, height_m=1.0) for _ in range(3))
    table = RangeTable()
    for row in range(len(ranges)):
        measurement = without_cir(ranges, row)
        range_m = measurement.range_m
        result = CorrectedRange(range_m, range_m, 0.0, 0.25, Status.NO_CIR, CorrectedBy.HOST, 1)
        expected, found = raw.add(measurement), passed.add(measurement, result)
        result = replace(result, status=Status.OK) if row == 100 else result
        table.add_corrected(measurement_key(measurement), result)
        corrected = mixed.add(measurement, result)
        if expected is not None:
            assert found.position.tolist() == expected.position.tolist()
    assert corrected.position.tolist() != expected.position.tolist(), (
        "after a corrected range, its variance counts"
    )
    (recorded,) = table.by_tag(HALL, 0.0, {}).tags
    *_, last = TagEstimator(EstimatorConfig(HALL, height=Height(1.0))).run(recorded.ranges)
    assert last.position.tolist() == corrected.position.tolist(), "recordings are located as live"


@pytest.mark.parametrize("command", [track, view])
def test_track_and_view_have_the_same_options(command):
    assert set(OPTIONS) <= set(signature(command).parameters)


def test_report_is_one_file_with_the_figures_of_track(imported, tmp_path: Path):
    bag, page = imported(""), tmp_path / "drive.html"
    options = ("--height", "0", "--json", "track.json", "--report", page, "--png", tmp_path / "map.png")
    succeed("track", bag, "-o", "track.mcap", *options, folder=tmp_path)
    rmse_m = json.loads((tmp_path / "track.json").read_text())["live"]["horizontal_rmse_m"]
    text = page.read_text()
    assert f"<td>Position RMSE, whole recording</td><td>{rmse_m:.3f} m</td>" in text
    assert "<strong>Position " in text
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert not re.search(r"<(script|link)[^>]+(src|href)=", text)
    assert "exists already" in run("track", bag, "-o", "other.mcap", *options, folder=tmp_path).stderr


def test_odometry_of_one_robot_is_not_used_for_several_tags(tmp_path: Path):
    bag = tmp_path / "two.mcap"
    write_records(
        bag, (Record(replace(record(number).measurement, tag_id=7 + number % 3)) for number in range(20))
    )
    config = EstimatorConfig(HALL, robot=RobotData())
    player = BagPlayer(bag, lambda: mitigation(TrackSettings()))
    player.index(config).join()
    assert "--odometry with the tags 7, 8, 9" in player.timeline.notices[-1]
    assert not player.timeline.estimates
