"""`uwb-mitigation track` and `survey` on bags, and on real recordings if available."""

import inspect
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import without_cir, write_corrected
from command_line import run, succeed
from drives import HALL, NANOSECONDS, Robot, circuit, drive, wrapped

from benchmarks.position_data import real_runs
from benchmarks.positions import evaluate, odometry_faults
from uwb_mitigation.commands import positioning
from uwb_mitigation.commands.offline.track import HoldoutErrors, held_out, worst_displaced
from uwb_mitigation.nodes.support.parameter_tables import TABLES
from uwb_mitigation.positioning import recorded_tracks as tracking
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.robust_update import CONSTANT_SD
from uwb_mitigation.positioning.recorded_tracks import track_tag
from uwb_mitigation.recordings.bag.odometry import read_odometry
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.recordings.mapping.mapped import MappedRecording
from uwb_mitigation.types.anchors import Anchor, AnchorMap, anchors_path, dump_anchors, parse_anchors
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, Record, Status
from uwb_mitigation.types.ros.poses import encode_pose
from uwb_mitigation.types.ros.topics import ODOMETRY, ODOMETRY_TRUTH, POSE_TYPE
from uwb_mitigation.types.tracks import Estimate, Ranges, TagRecording, TruePath


def write_drive(
    bag: Path, ranges: Ranges, truth: TruePath, too_long_m: float = 0.0, other_tag: int = 7
) -> Path:
    """Write a bag with the ranges (raw ones longer, if `too_long_m`), true positions and heights, and its anchors file.

    The last two ranges are one of another anchor, and one of another tag.
    """
    with BagWriter(bag, {"simulated": "true"}) as writer:
        for i in range(len(ranges)):
            measured, at = without_cir(ranges, i), truth.position[i]
            stamp, good = measured.stamp_ns, measured.range_m
            measured = replace(measured, range_m=good + too_long_m)
            writer.write(Record(measured, tag_position=tuple(at.tolist())))
            if too_long_m:
                corrected = CorrectedRange(
                    good, good + too_long_m, too_long_m, 0.01, Status.OK, CorrectedBy.HOST, 1
                )
                write_corrected(writer, measured, corrected)
            if i % 4 == 0:
                height = Estimate(stamp, at * (0, 0, 1), np.zeros(3), np.eye(6) * 0.0004)
                writer.write_message("/height", POSE_TYPE, encode_pose(height), stamp)
        for changes in ({"anchor_id": 99, "range_m": 1.0}, {"tag_id": other_tag, "range_m": good}):
            writer.write(Record(replace(measured, sequence=len(ranges), **changes)))
    anchors_path(bag).write_text(dump_anchors(HALL))
    return bag


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a 40 s drive past five anchors with raw ranges 0.6 m too long, and its anchors file."""
    ranges, truth = drive(seconds=40)
    # Corrected ranges have constant errors.
    ranges.range_m[:] += np.random.default_rng(1).normal(0.0, CONSTANT_SD, len(HALL))[ranges.anchor]
    return write_drive(tmp_path_factory.mktemp("hall") / "hall.mcap", ranges, truth, too_long_m=0.6)


def test_track_is_written_evaluated_and_read_by_evo(hall: Path, tmp_path: Path):
    out, tum, result = tmp_path / "track.mcap", tmp_path / "track.tum", tmp_path / "track.json"
    options = ["-o", out, "--tum", tum, "--height", "1.0", "--json", result]
    done = succeed("track", hall, *options, folder=tmp_path, columns=80)
    excerpt = json.loads(result.read_text())
    assert excerpt["unknown_anchors"] == {"99": 1}
    assert excerpt["corrected"] is True
    assert excerpt["tags"][0]["tag_id"] == 7
    for kind in ("live", "smoothed"):
        assert excerpt[kind]["horizontal_rmse_m"] < 0.2
        assert 0.25 < excerpt[kind]["nees_per_dof"] < 2
    assert excerpt["raw_live"]["horizontal_rmse_m"] > excerpt["live"]["horizontal_rmse_m"]
    assert "live, raw" in done.stdout
    for head in ("RMSE, m", "95 %, m", "in ellipse", "NEES"):
        assert head in done.stdout, "no title is broken"
    assert max(len(line) for line in done.stdout.splitlines() if line[:1] in ("┏", "│")) <= 80
    assert excerpt["snapshot"]["horizontal_rmse_m"] > 1.5 * excerpt["live"]["horizontal_rmse_m"]
    assert excerpt["hdop_median"] < 3
    *anchors, every = excerpt["held_out"]
    assert [one["anchor_id"] for one in anchors] == [1, 2, 3, 4, 5]
    assert every["anchor_id"] is None
    for one in excerpt["held_out"]:
        assert one["corrected_m"] < 0.3
        assert one["raw_m"] > 0.4, "they are 0.6 m too long"
    assert anchors_path(out).read_text() == dump_anchors(HALL, "anchors of the track of hall.mcap")
    (live,), (truth,) = (read_truth(out, topic).items() for topic in (ODOMETRY, ODOMETRY_TRUTH))
    assert (live[0], truth[0]) == (7, 7)
    live = live[1]
    off = live.position - truth[1].position_at(live.stamp_ns)
    assert np.nanmean(np.hypot(*off[:, :2].T)) < 0.2
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file(tum)
    assert read.num_poses >= 400
    np.testing.assert_allclose(read.timestamps[0], live.stamp_ns[0] / 1e9, atol=2.0)


def test_held_out_residuals_show_the_offset_of_one_anchor():
    ranges, truth = drive(seconds=40, offset_m=0.0)
    config = EstimatorConfig(HALL, height=Height(1.0, 0.1))
    one = track_tag(recording_of(ranges, truth), config)
    wrong, worse = (replace(ranges, range_m=ranges.range_m + m * (ranges.anchor == 2)) for m in (1.0, 1.5))
    one = replace(one, recording=TagRecording(7, wrong, worse, True, truth))
    found = held_out([one], config)
    assert found[2].raw_m == pytest.approx(1.0, abs=0.1)
    assert found[2].corrected_m - found[2].raw_m == pytest.approx(0.5, abs=1e-6), (
        "its ranges do not move the track"
    )
    few = replace(one, recording=replace(one.recording, raw=wrong.take(wrong.anchor < 3), corrected=False))
    assert [(other.ranges, math.isnan(other.raw_m)) for other in held_out([few], EstimatorConfig(HALL))] == [
        (0, True)
    ] * 6


def test_recording_that_cannot_be_tracked_is_refused(hall: Path, tmp_path: Path):
    out, line, others = (tmp_path / name for name in ("track.mcap", "line.yaml", "others.yaml"))
    line.write_text(dump_anchors(HALL.moved(HALL.position * (1, 0, 0) + (0, 0, 1), HALL.sd)))
    others.write_text("anchors: [{id: 50, x: 0, y: 0, z: 0}]")
    for arguments, message in (
        (("--anchors", tmp_path / "no.yaml"), "no.yaml: no such file"),
        (("--area", "here"), "area 'here'"),
        (("--anchors", line, "--height", "1.0"), "0.00 m of a line"),
        (("--anchors", others), "ranges come from anchors: 1, 2"),
        (("--odometry", "/height"), "geometry_msgs"),
        (("--odometry", "/odom", "--lever-arm", "1,2"), "three numbers"),
        (("--odometry", "/odom", "--lever-arm", "0,0,nan"), "-100 to 100 m"),
    ):
        assert message in str(run("track", hall, "-o", out, *arguments, folder=tmp_path).stderr)
    assert not out.exists()


def test_tag_without_a_position_does_not_stop_the_others(tmp_path: Path):
    bag = write_drive(tmp_path / "two.mcap", *drive(seconds=10), other_tag=8)
    arguments = ("track", bag, "-o", tmp_path / "track.mcap", "--tum", tmp_path / "track.tum")
    assert "tag 8: no position can be determined from 1 ranges" in succeed(*arguments, folder=tmp_path).stderr
    assert [path.name for path in tmp_path.glob("*.tum")] == ["track.tag_7.tum"]
    (tmp_path / "track.mcap").unlink()
    assert "track.tag_7.tum: exists already" in run(*arguments, folder=tmp_path).stderr


def test_survey_improves_the_anchor_positions(hall: Path, tmp_path: Path):
    guesses, found, result = tmp_path / "guesses.yaml", tmp_path / "found.yaml", tmp_path / "found.json"
    off = HALL.position.copy()
    off[1] += (0.5, -0.4, 0.0)
    guesses.write_text(dump_anchors(HALL.moved(off, HALL.sd)))
    arguments = ("survey", hall, "-o", found, "--anchors", guesses, "--height", "1.0", "--json", result)
    hint = "Set --fixed for two or more anchors that are right"
    assert hint in " ".join(succeed(*arguments, folder=tmp_path).stderr.split())
    assert json.loads(result.read_text())["misplaced"] == [2]
    excerpt = parse_anchors(found.read_text(), "found")
    assert np.linalg.norm(excerpt.position[1] - HALL.position[1]) < 0.5
    assert run(*arguments, folder=tmp_path).returncode != 0
    fixed = succeed(*arguments, "--force", "--fixed", "1", "--fixed", "3", folder=tmp_path)
    assert hint not in " ".join(fixed.stderr.split())


def test_height_topic_is_used_and_excludes_a_constant_height(tmp_path: Path):
    result = tmp_path / "track.json"

    def up_and_down(time_s):
        return circuit(time_s) + np.outer(0.5 * np.sin(0.4 * time_s), (0, 0, 1))

    bag = write_drive(tmp_path / "flight.mcap", *drive(seconds=20, path=up_and_down))
    arguments = ("track", bag, "-o", tmp_path / "track.mcap", "--height-topic")
    succeed(*arguments, "/height", "--json", result, folder=tmp_path)
    excerpt = json.loads(result.read_text())
    for kind in ("live", "smoothed"):
        assert excerpt[kind]["horizontal_rmse_m"] < 0.2
        assert excerpt[kind]["height_rmse_m"] < 0.05
    assert excerpt["tags"][0]["warnings"] == []
    for more in (("/height", "--height", "1.0"), ("/nothing",)):
        assert run(*arguments, *more, "--force", folder=tmp_path).returncode != 0


@pytest.fixture(scope="module")
def robot_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a simulated drive with odometry and IMU, and its anchors file."""
    bag = tmp_path_factory.mktemp("robot") / "drive.mcap"
    succeed("data simulate --like drive --ranges 500 -o", bag, folder=bag.parent)
    return bag


def test_odometry_adds_the_heading_to_tracks(robot_bag: Path, tmp_path: Path, monkeypatch):
    results = []
    for number, options in enumerate(([], ["--odometry", "/odom"], ["--odometry", "/odom", "--imu", "/imu"])):
        out, report, tum = (tmp_path / f"{number}.{kind}" for kind in ("mcap", "json", "tum"))
        options += ["-o", out, "--height", "0", "--json", report, "--tum", tum]
        with monkeypatch.context() as patch:
            if number == 1:
                reader = "uwb_mitigation.commands.offline.track.read_range_frame"
                patch.setattr(reader, lambda bag: "uwb_antenna")
            ran = succeed("track", robot_bag, *options, folder=tmp_path)
        assert ("no transform from base_link to uwb_antenna" in ran.stderr) == (number == 1)
        assert ("lever arm" in ran.stderr) == (number == 1)
        results.append(json.loads(report.read_text()))
    without, with_odometry, with_imu = results
    assert without["live"]["heading_rmse_deg"] is None
    assert 0.0 < with_odometry["live"]["heading_found_after_s"] < 15.0
    for kind in ("live", "smoothed"):
        assert with_odometry[kind]["horizontal_rmse_m"] < without[kind]["horizontal_rmse_m"]
        assert with_odometry[kind]["heading_rmse_deg"] < 10.0
        assert with_imu[kind]["heading_rmse_deg"] < 10.0
        assert with_imu[kind]["heading_rmse_deg"] != with_odometry[kind]["heading_rmse_deg"]
    quaternions = np.loadtxt(tum)[:, 4:]
    assert np.abs(quaternions[:, 2]).max() > 0.5
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-5)
    forward, left, _ = read_odometry(out, ODOMETRY).twist[250:].T
    assert np.percentile(np.abs(left), 95) < 0.3 * np.median(forward), "in the axes of the robot"
    # The written truth contains the heading.
    (truth,) = read_truth(out).values()
    (recorded,) = read_truth(robot_bag).values()
    np.testing.assert_allclose(wrapped(truth.yaw - recorded.yaw), 0.0, atol=1e-9)


@pytest.mark.parametrize("is_wrong", [False, True])
def test_odometry_that_contradicts_the_ranges_is_reported(is_wrong: bool):
    robot = Robot(seconds=40)
    ranges, odometry = robot.ranges(seconds=40), robot.odometry
    truth = TruePath(ranges.stamp_ns, circuit(ranges.stamp_ns / NANOSECONDS))
    wrong = odometry_faults(odometry)["sign of yaw rate"]
    config = replace(robot.config, robot=RobotData(wrong if is_wrong else odometry))
    warnings = track_tag(recording_of(ranges, truth), config).warnings
    assert any("odometry contradicted" in warning for warning in warnings) == is_wrong


def test_commands_and_node_use_the_acceleration_of_the_model():
    defaults = {parameter.name: parameter.default for parameter in TABLES["locator"]}
    assert defaults["acceleration"] == NoiseModel().acceleration
    for command in (positioning.track, positioning.survey):
        assert inspect.signature(command).parameters["acceleration"].default == NoiseModel().acceleration


def recording_of(ranges: Ranges, truth: TruePath) -> TagRecording:
    return TagRecording(7, ranges, ranges, False, truth)


def displaced(ranges: Ranges, truth: TruePath, anchors: AnchorMap = HALL) -> list[Anchor]:
    config = EstimatorConfig(anchors, height=Height(1.0))
    residuals = held_out([track_tag(recording_of(ranges, truth), config)], config)
    return [row.fitted for row in residuals if row.fitted is not None]


def test_anchor_is_accused_only_if_another_position_explains_its_ranges():
    ranges, truth = drive(seconds=40, rate_hz=10.0, seed=1)
    # The track without anchor 4 fits it worse than anchor 1, which is wrong.
    for row, shift in ((2, (1.5, -1.5, 0.0)), (0, (1.5, 1.5, 0.0))):
        wrong = HALL.position + (np.arange(len(HALL)) == row)[:, None] * shift
        (fitted,) = displaced(ranges, truth, HALL.moved(wrong, HALL.sd))
        off_m = np.subtract(fitted.position, HALL.position[row])
        assert fitted.id == row + 1
        assert np.abs(off_m).max() < 2.0 * fitted.sd < 0.5
    noise_m = np.random.default_rng(2).normal(0.0, 0.4, len(ranges))
    noisy = replace(ranges, range_m=ranges.range_m + noise_m)
    (less_certain,) = displaced(noisy, truth, HALL.moved(wrong, HALL.sd))
    assert less_certain.sd > 1.5 * fitted.sd
    assert displaced(ranges, truth) == []
    assert displaced(replace(ranges, range_m=ranges.range_m + 0.8 * (ranges.anchor == 2)), truth) == []
    late = (ranges.anchor == 2) & (ranges.stamp_ns > 20 * NANOSECONDS)
    ranges.range_m[late] += np.random.default_rng(1).exponential(1.5, int(late.sum()))
    assert displaced(ranges, truth) == []


@pytest.mark.parametrize(("anchors", "accused", "expected"), [(4, 1, {1}), (4, 2, set()), (5, 2, {2})])
def test_several_accusations_of_four_anchors_contradict_each_other(
    anchors: int, accused: int, expected: set[int]
):
    fits = [HALL.anchors[row] if row < accused else None for row in range(anchors)]
    rows = [HoldoutErrors(row + 1, 100, 0.1 * row, 0.0, fit) for row, fit in enumerate(fits)]
    assert set(worst_displaced([*rows, HoldoutErrors(None, 100, 0.1, 0.1)])) == expected


@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.5)])
def test_failed_smoothing_is_reported(monkeypatch: pytest.MonkeyPatch, shift: tuple[float, float, float]):
    monkeypatch.setattr(
        tracking, "smooth", lambda *given: replace(given[2], position=given[2].position + shift)
    )
    ranges, truth = drive(seconds=10)
    warnings = track_tag(recording_of(ranges, truth), EstimatorConfig(HALL)).warnings
    assert any("smoothing increases the RMSE" in warning for warning in warnings)


def test_mirrored_heights_are_stated_once_with_a_remedy():
    level = HALL.moved(HALL.position * (1, 1, 0) + (0, 0, 2.5), HALL.sd)
    found = track_tag(recording_of(*drive(level, seconds=20)), EstimatorConfig(level))
    assert found.as_json()["determination"]["state"] == "mirrored height"
    (warning,) = found.warnings
    assert "Remedy: the height of the tag, or an area above z = 2.50 m or below 2.50 m" in warning


def test_bad_geometry_is_reported():
    near_line = HALL.moved(HALL.position * (1, 0.02, 0) + (0, -6, 1), HALL.sd)
    ranges, truth = drive(near_line, seconds=10)
    area = Area((-50, 0, 0), (50, 50, 3))
    config = EstimatorConfig(near_line, NoiseModel(range_sd=0.02), Height(1.0), area)
    assert not track_tag(recording_of(ranges, truth), config).warnings
    ranges, far = drive(near_line, seconds=10, path=lambda t: np.add(circuit(t), (80, 0, 0)))
    config = replace(config, area=Area((0, -5, 0), (200, 50, 3)))
    assert track_tag(recording_of(ranges, far), config).warnings[0].startswith("weak direction")


@pytest.fixture(scope="module")
def hanyang(data: Path) -> Path:
    folder = data / "hanyang_outdoor"
    if not folder.is_dir():
        pytest.skip(f"Hanyang's runs are not at {folder}")
    return folder


def test_real_run_is_read_and_imported_with_its_stamps_anchors_and_positions(hanyang: Path, tmp_path: Path):
    source = open_recording(hanyang / "LOS_A2")
    assert isinstance(source, MappedRecording)
    records = list(source)
    assert len(records) == 8219
    assert [anchor.id for anchor in source.anchors.anchors] == [3, 5, 9, 12]
    stamps = [record.measurement.stamp_ns for record in records]
    assert stamps == sorted(stamps)
    assert source.skipped["dropped: pose z from_median 0.5"] > 100
    heights = [record.tag_position[2] for record in records if record.tag_position is not None]
    assert 0.7 < min(heights) < max(heights) < 1.7
    succeed("data", "import", hanyang / "LOS_A2", "-o", tmp_path / "a2.mcap", folder=tmp_path)
    assert [record.measurement.stamp_ns for record in open_recording(tmp_path / "a2.mcap")] == stamps
    assert parse_anchors((tmp_path / "a2.anchors.yaml").read_text(), "a2").anchors == source.anchors.anchors


@pytest.mark.slow
def test_real_drives_reach_the_documented_errors(hanyang: Path):
    runs, skipped = real_runs(hanyang.parent)
    entries = [evaluate(run, calibrate=False) for run in runs if run.set_name == "hanyang"]
    assert len(entries) == 6
    assert not [one for one in skipped if "hanyang" in one["path"]]
    locator = [entry["rows"]["raw_locator"] for entry in entries]
    assert np.mean([row["rmse_m"] for row in locator]) < 0.55
    assert min(row["coverage95"] for row in locator) > 0.89
    assert max(entry["ratio_to_best_baseline"] for entry in entries) < 1.1
    assert np.mean([entry["rows"]["smoothed"]["rmse_m"] for entry in entries]) < 0.40
    assert np.mean([entry["rows"]["raw_least_squares"]["rmse_m"] for entry in entries]) > 2


def test_recordings_that_cannot_be_read_are_reported_and_the_other_ones_continue(tmp_path: Path):
    (tmp_path / "holiday").mkdir()
    (tmp_path / "rcv" / "one").mkdir(parents=True)
    (tmp_path / "rcv" / "one" / "anchor_1.csv").write_text("nonsense\n1\n")
    (tmp_path / "miluv").mkdir()
    runs, skipped = real_runs(tmp_path)
    assert runs == []
    assert [Path(one["path"]).name for one in skipped] == ["holiday", "miluv", "one"]
    assert all(one["reason"] for one in skipped)
