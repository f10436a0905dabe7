"""`uwb-mitigation calibrate`: a bundle and offsets from a simulated drive, and from an external localisation."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from bag_material import write_records
from command_line import run, succeed
from drives import HALL, circuit, drive

from uwb_mitigation.calibration import site as site_module
from uwb_mitigation.calibration import solution as solution_module
from uwb_mitigation.calibration.held_out import MAX_INCREASE, HeldOut, select
from uwb_mitigation.calibration.hypotheses import AnchorHypotheses
from uwb_mitigation.calibration.site import calibrate_site
from uwb_mitigation.calibration.site_data import read_site
from uwb_mitigation.calibration.solution import Localisation, solve_with_truth, solve_without_truth
from uwb_mitigation.commands.calibrate import _body_of_tag, _lever_arm_in
from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.recordings.bag import pose_paths
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.anchors import Anchor, AnchorMap, save_anchors
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment, Status
from uwb_mitigation.types.offsets import read_offsets
from uwb_mitigation.types.ros.poses import Fields, encode_odometry, header_fields, quaternion, vector
from uwb_mitigation.types.ros.schemas import serialize
from uwb_mitigation.types.ros.topics import TF_TYPE
from uwb_mitigation.types.tracks import Estimate, Heading, PosePath, TruePath

UNIVERSAL = load_bundle(default_model_path())
SITE = AnchorMap([*HALL.anchors, Anchor(6, (6.0, 9.0, 1.5), 0.01), Anchor(7, (0.0, 4.5, 1.5), 0.01)])
OWN = np.array([0.4, 0.0, 0.35, -0.05, 0.25, 0.05, 0.15])
LEVER = np.array([0.4, 0.1, 0.0])


def arm_to(frame):
    """Return a TFMessage in CDR: a frame at `LEVER` in base_link."""
    transform = Fields(translation=vector(*LEVER), rotation=quaternion(0.0))
    link = Fields(header=header_fields(0, "base_link"), child_frame_id=frame, transform=transform)
    return serialize(TF_TYPE, transforms=[link])


def with_errors(ranges, seed):
    """Return received powers, dBm, and ranges with an offset of each anchor and a line in the power, m."""
    power = -80 - 0.5 * np.random.default_rng(seed).normal(0, 8, len(ranges))
    return power, ranges.range_m + OWN[ranges.anchor] - 0.02 * (power + 80)


def records_of(ranges, power, value, gap=np.nan, **kind):
    first_path = power - np.broadcast_to(gap, len(ranges))
    for i, stamp in enumerate(ranges.stamp_ns.tolist()):
        levels = {"rx_power_dbm": float(power[i]), "first_path_power_dbm": float(first_path[i])}
        cir = Cir(np.zeros(0, np.int16), **levels, **kind)
        anchor = SITE.anchors[int(ranges.anchor[i])].id
        yield Record(RangeMeasurement(stamp, 7, anchor, i, 0, float(value[i]), cir))


def localisation_of(path):
    poses = PosePath(path.stamp_ns, path.position, np.tile([0.0, 0.0, 0.0, 1.0], (len(path), 1)))
    return Localisation("/odom", {7: [poses]}, time_offset_s=0.0)


def calibrated(records, path=None):
    """Return the calibration of a drive at a constant height, with the path as ground truth."""
    site = read_site([records], SITE, UNIVERSAL)
    if path is None:
        solution = solve_without_truth(site, height=Height(1.0), area=None)
    else:
        solution = solve_with_truth(site, localisation_of(path), height=Height(1.0))
    return calibrate_site(site, UNIVERSAL, solution)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return a folder with drives past seven anchors without CIRs and with a localisation delayed by 0.3 s."""
    folder = tmp_path_factory.mktemp("a site")
    save_anchors(folder / "anchors.yaml", SITE)
    ranges, path = drive(SITE, seconds=120.5, rate_hz=8.0, offset_m=0.0)
    power, value = with_errors(ranges, seed=2)
    turn = 0.6 * ranges.stamp_ns / 1e9
    with (
        BagWriter(folder / "drive.mcap", {"simulated": "true"}) as bag,
        BagWriter(folder / "few.mcap", {}) as few,
        BagWriter(folder / "gross.mcap", {}) as gross,
        BagWriter(folder / "rare.mcap", {}) as rare,
    ):
        for i, record in enumerate(records_of(ranges, power, value)):
            stamp, anchor = record.measurement.stamp_ns, record.measurement.anchor_id
            bag.write(record)
            wrong = replace(record.measurement, range_m=float(value[i]) + 150.0 * (i % 107 == 5))
            gross.write(replace(record, measurement=wrong))
            if anchor != 5 or i == len(ranges) - 1:
                rare.write(replace(record, measurement=replace(record.measurement, frame_id="antenna")))
            if i % 19 == 0:
                few.write(record)
            if i % 2 == 0:
                c, s = np.cos(turn[i]), np.sin(turn[i])
                frame = path.position[i] - (c * LEVER[0] - s * LEVER[1], s * LEVER[0] + c * LEVER[1], 0.0)
                late = stamp + 300_000_000
                heading = Heading(float(turn[i]), np.zeros(4))
                pose = Estimate(late, frame, np.zeros(3), np.zeros((6, 6)), heading)
                for one, body in ((bag, "base_link"), (few, "uwb_tag"), (rare, "base_link")):
                    data = encode_odometry(pose, child_frame_id=body)
                    one.write_message("/odom", "nav_msgs/msg/Odometry", data, late)
        rare.write_message("/tf_static", TF_TYPE, arm_to("antenna"), int(ranges.stamp_ns[0]))
    other, _ = drive(SITE, seconds=80, rate_hz=8.0, offset_m=0.0, seed=5)
    write_records(folder / "other.mcap", records_of(other, *with_errors(other, seed=6)))
    return folder


LEVEL = "--anchors anchors.yaml --height 1.0"


@pytest.fixture(scope="module")
def clean(site):
    """The result of a drive without outliers, calibrated with a constant height."""
    words = f"calibrate drive.mcap {LEVEL} -o site.onnx --json r.json --report r.html --check other.mcap"
    succeed(words, folder=site)
    return json.loads((site / "r.json").read_text())


def test_drive_yields_offsets_that_improve_another_drive(site, clean):
    assert (clean["truth"], clean["refused"], clean["chosen"]) == ("none", None, "offsets")
    ((raw_m, corrected_m),) = clean["check_mae_m"]
    assert corrected_m < 0.8 * raw_m
    assert clean["calibrated_mae_m"] < clean["raw_mae_m"]
    assert -0.5 < clean["live_position_change"] < -0.012
    # Half of the differences is subtracted, because walls look like them.
    offset_m = np.array([clean["offsets_m"][f"7-{anchor}"] for anchor in range(1, 8)])
    assert offset_m - offset_m.mean() == pytest.approx(0.5 * (OWN - OWN.mean()), abs=0.06)
    # The errors of this drive are symmetric: the thresholds for obstacles make the common offset too small.
    assert -0.1 < (offset_m - OWN).mean() < 0.0
    again = run(f"calibrate drive.mcap {LEVEL} -o site.onnx", folder=site)
    assert (again.returncode, "--force" in again.stderr) == (2, True)


def test_offsets_of_ranges_without_cirs_are_no_corrections_by_a_model(site, clean):
    """The locator would treat them as ranges without obstacles."""
    bundle, offsets = load_bundle(site / "site.onnx"), read_offsets(str(site / "site.offsets.yaml"))
    assert "without truth" in bundle.card.origin
    measured = RangeMeasurement(0, 7, 5, 0, 0, 5.3, Cir(np.zeros(0, np.int16), rx_power_dbm=-85.0))
    shipped, corrected = (
        Mitigation(UNIVERSAL).correct(measured),
        Mitigation(bundle, offsets).correct(measured),
    )
    assert (corrected.status, corrected.variance_m2) == (Status.NO_CIR, shipped.variance_m2)
    assert corrected.range_m == pytest.approx(5.3 - clean["offsets_m"]["7-5"], abs=1e-6)


def test_page_of_a_calibration_needs_no_other_file(site, clean):
    page = (site / "r.html").read_text()
    assert "default-src 'none'; script-src 'unsafe-inline'" in page
    for figure in ("map", "residuals", "errors", "distribution", "offsets"):
        assert f'"name":"{figure}"' in page
    for text in (
        f"{clean['chosen']} (chosen)",
        "drive.mcap",
        f"{clean['model_id']:08x}",
        "model:=site.onnx -p offsets:=site.offsets.yaml",
        "Compared with raw ranges, the live position error on another drive decreases by at least",
    ):
        assert text in page


def test_delayed_localisation_provides_the_truth(site):
    succeed(
        f"calibrate drive.mcap {LEVEL} -o odom.onnx --json o.json --truth-topic /odom --estimate-lever-arm",
        folder=site,
    )
    result = json.loads((site / "o.json").read_text())
    assert result["truth"] == "/odom"
    assert result["live_position_change"] < -0.2
    assert result["localisation"]["time_offset_s"] == pytest.approx(0.3, abs=0.02)
    assert np.abs(np.array(result["localisation"]["lever_arm_m"]) - LEVER)[:2].max() < 0.05
    assert "with truth from /odom" in load_bundle(site / "odom.onnx").card.origin
    wrong = run(f"calibrate drive.mcap {LEVEL} -o x.onnx --truth-topic /amcl_pose", folder=site)
    assert (wrong.returncode, "/odom (nav_msgs/msg/Odometry)" in wrong.stderr) == (1, True)


@pytest.mark.parametrize(
    ("own", "size", "chosen", "refusal"),
    [
        (
            OWN[:6] / 4.0,
            1.0,
            "common offset",
            "estimates the common offset itself, and offsets of single anchors need more anchors",
        ),
        (np.full(7, 0.3), 1.0, "common offset", "offsets of single anchors are not clearly better"),
        (OWN, 0.5, "common offset", "look like a displacement of the whole track"),
    ],
)
def test_without_cirs_a_drive_past_seven_anchors_with_different_offsets_is_needed(own, size, chosen, refusal):
    centre = np.array([6.0, 4.5, 1.0])

    def path(time_s):
        return centre + size * (circuit(time_s) - centre)

    ranges, _ = drive(SITE, seconds=100, rate_hz=10.0, offset_m=0.0, path=path)
    ranges = ranges.take(ranges.anchor < len(own))
    calibration = calibrated(
        records_of(ranges, np.full(len(ranges), np.nan), ranges.range_m + own[ranges.anchor])
    )
    assert calibration.chosen == chosen
    assert refusal in calibration.refusal
    if np.ptp(own) == 0.0:
        assert max(sd_m for _, sd_m in calibration.pairs.values()) < 0.055, "the prior of offsets is small"


@pytest.mark.parametrize("truth", [False, True])
def test_errors_of_a_half_are_computed_with_the_offsets_of_the_other(truth):
    ranges, path = drive(SITE, seconds=100, rate_hz=20.0, offset_m=0.0)
    is_late = ranges.stamp_ns > 50 * 10**9
    power, value = with_errors(ranges, seed=2)
    value += np.where(is_late & (ranges.anchor == 2), 0.4, 0.0)
    calibration = calibrated(records_of(ranges, power, value), path if truth else None)
    errors = calibration.held_out[0].residual_m["offsets"]
    late_m, early_m = (
        np.array([np.nanmedian(errors[half & (ranges.anchor == row)]) for row in (2, 0)])
        for half in (is_late, ~is_late)
    )
    # Without ground truth, half of the difference is subtracted, and the error of one anchor also moves the positions that the others
    # are compared with. With the offsets of the same half, the differences would be 0.0 and 0.2.
    expected_m, tolerance_m = (0.8, 0.1) if truth else (0.6, 0.19)
    assert late_m - early_m == pytest.approx(np.array([expected_m, 0.0]), abs=tolerance_m)


def test_correction_is_selected_only_if_it_improves_each_drive():
    def errors(scale, is_separate=True, seed=1):
        rng = np.random.default_rng(seed)
        residual_m = {name: rng.normal(0.0, sd, 400) for name, sd in zip("abc", scale, strict=True)}
        return HeldOut(np.arange(400) // 40, residual_m, {}, is_separate)

    good, bad = errors((0.3, 0.2, 0.1)), errors((0.3, 0.2, 0.21), seed=2)
    halves = errors((0.3, 0.2, 0.1), is_separate=False)
    for parts, chosen in (([good], "c"), ([halves, bad], "b"), ([errors((0.3, 0.3, 0.3))], "a")):
        assert select(parts, ["a", "b", "c"], "a") == chosen


@pytest.mark.parametrize(
    ("range_m", "live_m", "refusal"),
    [
        (0.1, (0.9, 1.08), "the live position is not clearly better than with raw ranges"),
        (0.297, (0.5, 0.5), "the ranges are not better than with raw ranges"),
    ],
)
def test_correction_that_would_be_refused_is_not_selected_if_a_simpler_one_helps(range_m, live_m, refusal):
    block = np.arange(400) // 40
    residual_m = {name: np.full(400, value) for name, value in (("raw", 0.3), ("a", 0.2), ("b", range_m))}
    errors_m = {"raw": np.ones(400), "a": np.where(block % 2, 0.98, 1.0), "b": np.where(block % 2, *live_m)}
    errors = HeldOut(block, residual_m, errors_m, True)
    assert errors.live_gain("b", "a").mean > -MAX_INCREASE
    assert select([errors], ["a", "b"], "raw") == "a"
    assert (errors.refusal("a", "raw"), errors.refusal("b", "raw")) == ("", refusal)


def test_localisation_needs_few_ranges(site):
    result, done = figures(site, "few.mcap", "--height 1.0 --truth-topic /odom --estimate-lever-arm")
    assert "no transform" not in done.stderr  # uwb_tag is at the antenna
    # Without the held-out quarter, there are too few to estimate a time offset and a lever arm.
    assert 40 <= result["labelled"] < 53


def figures(site, bag, options):
    words = f"calibrate {bag} --anchors anchors.yaml {options} -o f.onnx --json f.json --force"
    done = succeed(words, folder=site)
    return json.loads((site / "f.json").read_text()), done


def test_nine_gross_outliers_change_no_result(site, clean):
    with_outliers, done = figures(site, "gross.mcap", "--height 1.0")
    assert (clean["outliers"], with_outliers["outliers"]) == (0, 9)
    assert "9 outliers" in done.stderr
    for key in ("raw_mae_m", "calibrated_mae_m"):
        assert with_outliers[key] == pytest.approx(clean[key], rel=0.05)


def test_heights_come_from_a_topic_and_stamps_are_shifted(site, clean):
    shifted, _ = figures(site, "drive.mcap", "--height-topic /odom --stamp-offset 0.3")
    # The localisation is delayed by 0.3 s: without the option, it would not cover the first three ranges.
    assert shifted["skipped"] == {"no height at that time": 1}
    for pair, value in clean["offsets_m"].items():
        assert shifted["offsets_m"][pair] == pytest.approx(value, abs=0.02)
    unusable = run(
        "calibrate drive.mcap --anchors anchors.yaml --height-topic /odom --stamp-offset 3600 -o x.onnx",
        folder=site,
    )
    assert re.search(r"no range can be used: \d+ x no height at that time", unusable.stderr), unusable.stderr
    both = run(f"calibrate drive.mcap {LEVEL} --height-topic /odom -o x.onnx", folder=site)
    assert (both.returncode, "either of them" in both.stderr) == (2, True)


def test_lever_arm_that_contradicts_the_ranges_is_refused(site):
    """Without a transform it is 0."""
    done = run(f"calibrate drive.mcap {LEVEL} --truth-topic /odom -o f.onnx --force", folder=site)
    assert done.returncode == 1
    assert "no transform from base_link" in done.stderr
    found = re.search(
        r"the lever arm \(0.00, 0.00\) m contradicts the ranges: they fit \((.*), (.*)\) m", done.stderr
    )
    assert found, done.stderr
    assert [float(value) for value in found.groups()] == pytest.approx(LEVER[:2], abs=0.05)
    options = "--height 1.0 --truth-topic /odom --lever-arm 0.4,0.1,0 --time-offset 0.3"
    assert figures(site, "drive.mcap", options)[0]["localisation"]["lever_arm_m"] == LEVER.tolist()


def test_lever_arm_is_the_transform_to_the_frame_of_the_ranges(site):
    result, done = figures(site, "rare.mcap", "--height 1.0 --truth-topic /odom --time-offset 0.3")
    assert result["localisation"]["lever_arm_m"] == LEVER.tolist()
    assert result["localisation"]["lever_arm_sd_m"] == [0.0] * 3
    assert "no transform" not in done.stderr
    # The only range of a pair is later than the last pose, so that it gets the common offset.
    others = [result["offsets_m"][f"7-{anchor}"] for anchor in (1, 2, 3, 4, 6, 7)]
    assert min(others) < result["offsets_m"]["7-5"] < max(others)
    assert 0.1 < result["offset_sd_m"]["7-5"] < 0.5


def test_refusal_is_reported_in_the_json_and_writes_no_model(site):
    save_anchors(site / "few.yaml", AnchorMap(SITE.anchors[:2]))
    words = "calibrate drive.mcap --anchors few.yaml -o short.onnx --json s.json --force"
    assert run(words, folder=site).returncode == 1
    result = json.loads((site / "s.json").read_text())
    assert "not in the anchors file: 3, 4, 5, 6, 7" in result["refused"]
    assert result["offsets_m"] == {}
    assert not (site / "short.onnx").exists()
    assert not (site / "short.offsets.yaml").exists()


@pytest.fixture(scope="module")
def located():
    """Return the path of a drive, and the calibration with it."""
    ranges, path = drive(SITE, seconds=100, rate_hz=10.0, offset_m=0.0)
    return path, calibrated(records_of(ranges, *with_errors(ranges, seed=2)), path)


@pytest.mark.parametrize(
    ("name", "factor", "refusal"),
    [
        ("residual_m", 1.0, "the ranges are not better than with raw ranges"),
        ("live_m", 1.0, "the live position is not clearly better than with raw ranges"),
        ("live_m", np.nan, "there are too few live positions to compare"),
    ],
)
def test_calibration_is_refused_without_gain(located, name, factor, refusal):
    assert not located[1].refusal
    assert without_gain(located[1], name, factor).refusal == f"on the drive of the check {refusal}"


def without_gain(calibration, name="residual_m", factor=1.0):
    """Return the calibration with a check on which its errors are those of raw ranges, times a factor."""
    held_out = calibration.held_out[0]
    errors = getattr(held_out, name)
    check = replace(held_out, **{name: errors | {calibration.chosen: factor * errors["raw"]}})
    return replace(calibration, held_out=(held_out, check))


def test_calibration_without_gain_is_written_only_with_force(site, located, monkeypatch):
    monkeypatch.setattr(site_module, "calibrate_site", lambda *_, **__: without_gain(located[1]))
    monkeypatch.setattr(solution_module, "solve_without_truth", lambda *_, **__: located[1].solution)
    words = f"calibrate drive.mcap {LEVEL} -o harm.onnx --json h.json"
    assert run(words, folder=site).returncode == 1
    assert "not written" in json.loads((site / "h.json").read_text())["refused"]
    assert not (site / "harm.onnx").exists()
    succeed(f"{words} --force", folder=site)
    assert (site / "harm.onnx").exists()


@pytest.mark.parametrize("level", ["one", "pair"])
def test_standard_deviation_of_an_offset_contains_the_part_that_is_not_subtracted(located, level):
    solution = replace(located[1].solution, common_share=0.5, offset_share=0.5)
    published, offsets = solution.subtracted(level), solution.offsets(level)
    for (tag, anchor), (value, sd) in solution.pairs.items():
        remaining_m = value - offsets.lookup([tag], [anchor])[0]
        assert published[tag, anchor][1] == pytest.approx(np.hypot(sd, remaining_m), abs=1e-6)
    assert offsets.pair_sd == ({pair: sd for pair, (_, sd) in published.items()} if level == "pair" else {})


@pytest.mark.parametrize(("wrong", "match"), [(range(1, 8), "check the unit"), ([1], "and anchor 1;")])
def test_offsets_above_a_metre_are_refused(located, wrong, match):
    calibration = located[1]
    pairs = {
        (tag, anchor): (value + 1.2 * (anchor in wrong), sd)
        for (tag, anchor), (value, sd) in calibration.solution.pairs.items()
    }
    with pytest.raises(DatasetError, match=match):
        calibrate_site(calibration.site, UNIVERSAL, replace(calibration.solution, pairs=pairs))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (
            {3: SITE.position[3] + (0.0, 1.0, 0.0)},
            r"anchor 4 contradicts .* x = -?0\.[01]. m, y = (8\.[89]|9\.[01]). m .* 1\.\d m from",
        ),
        ({0: SITE.position[2], 2: SITE.position[0]}, "anchors 1 and 3"),
    ],
)
def test_anchors_at_wrong_positions_are_named_with_truth_too(located, wrong, named):
    path, calibration = located
    position = SITE.position.copy()
    position[list(wrong)] = list(wrong.values())
    site = replace(calibration.site, anchors=SITE.moved(position, SITE.sd))
    with pytest.raises(DatasetError, match=named):
        solve_with_truth(site, localisation_of(path))


def test_each_tag_has_its_own_lever_arm():
    arms, records = {9: (0.3, 0.1, 0.0), 7: (-0.4, 0.0, 0.0)}, []
    for tag_id, arm in arms.items():
        ranges, path = drive(
            SITE, seconds=40, rate_hz=10.0, offset_m=0.0, path=lambda t, arm=arm: circuit(t) + arm
        )
        records += [
            replace(record, measurement=replace(record.measurement, tag_id=tag_id))
            for record in records_of(ranges, *with_errors(ranges, seed=3))
        ]
    robot = replace(path, position=path.position - arms[7])
    poses = localisation_of(robot).paths[7]
    localisation = Localisation("/odom", dict.fromkeys(arms, poses), 0.0, arms)
    site = read_site([records], SITE, UNIVERSAL)
    solution = solve_with_truth(site, localisation, height=Height(1.0))
    expected = robot.position_at(site.ranges.stamp_ns) + [arms[site.tags[tag].tag_id] for tag in site.tag]
    assert np.nanmax(np.abs(solution.alignment.position - expected)) < 0.01


def test_small_displacement_and_heavy_tail_accuse_no_anchor():
    ranges, path = drive(seconds=160, rate_hz=10.0, offset_m=0.2)
    rng = np.random.default_rng(4)
    blocked = (ranges.anchor == 3) & (rng.random(len(ranges)) < 0.8)
    tail = np.where(blocked, rng.exponential(1.0, len(ranges)), 0.0)
    exact = np.linalg.norm(path.position - HALL.position[ranges.anchor], axis=1)
    one = HALL.position + np.outer(np.arange(5) == 1, (0.45, 0.0, 0.0))
    for anchors, value in (
        (HALL.moved(HALL.position + np.array([0.15, 0.0, 0.0]), HALL.sd), ranges.range_m),
        (HALL.moved(one, HALL.sd), exact),
        (HALL, ranges.range_m + tail),
    ):
        moved = replace(ranges, range_m=value)
        AnchorHypotheses(anchors, moved, path.position).check("the localisation", is_independent=True)


def test_tag_is_matched_with_its_own_frame_in_any_namespace():
    assert _body_of_tag(7, ["left/tag_7", "left/tag_8"], "x") == "left/tag_7"
    assert _body_of_tag(7, ["base_link"], "x") == "base_link"
    for names in (["tag_8"], ["base_link", "camera"], ["left/tag_7", "right/tag_7"]):
        with pytest.raises(RecordingError):
            _body_of_tag(7, names, "x")


def test_lever_arm_is_read_from_every_bag_and_must_be_the_same(site, monkeypatch):
    arms = {"a": None, "b": (0.4, 0.1, 0.0), "c": (0.4, 0.1, 0.2)}
    monkeypatch.setattr(pose_paths, "read_lever_arm", lambda bag, body, frame: arms[bag])
    assert _lever_arm_in(["a", "b"], ["base_link"] * 2, ["antenna"]) == arms["b"]
    assert _lever_arm_in(["a"], ["base_link"], ["antenna"]) is None
    with pytest.raises(RecordingError):
        _lever_arm_in(["b", "c"], ["base_link"] * 2, ["antenna"])


def test_recording_with_cirs_uses_the_universal_network(tmp_path):
    source = SimulatedSource.with_anchors(5, seed=4, count=1000, rate_hz=20.0)
    save_anchors(tmp_path / "anchors.yaml", source.anchors)
    with BagWriter(tmp_path / "drive.mcap", {"simulated": "true"}) as bag:
        records = list(source)
        for number, record in enumerate(records):
            # The offset of an anchor is not the common one, but only that is subtracted.
            offset_m = 0.6 if record.measurement.anchor_id == 5 else 0.2
            measured = replace(record.measurement, range_m=record.measurement.range_m + offset_m)
            if number % 7 == 0:
                measured = replace(measured, cir=replace(measured.cir, samples=np.zeros(0, np.int16)))
            bag.write(replace(record, measurement=measured, truth=None))
    done = succeed(
        "calibrate drive.mcap --anchors anchors.yaml --height 0.0 -o site.onnx --json r.json", folder=tmp_path
    )
    result = json.loads((tmp_path / "r.json").read_text())
    # Ranges without a CIR contribute to the track; the model is fitted to the others.
    without = len(range(0, len(records), 7))
    assert (result["ranges"], result["skipped"]) == (len(records), {})
    assert f"{without} ranges without a usable CIR" in done.stderr
    assert result["labelled"] <= len(records) - without
    # From one drive, the CIRs are only used as without a calibration: same corrections and variances, minus the common offset.
    assert (result["chosen"], result["compared_with"]) == (
        "common offset + universal network",
        "shipped model alone",
    )
    assert result["calibrated_mae_m"] < 0.98 * result["baseline_mae_m"]
    assert "Compared with the shipped model alone" in done.stdout
    with_offset = Mitigation(
        load_bundle(tmp_path / "site.onnx"), read_offsets(str(tmp_path / "site.offsets.yaml"))
    )
    measured = [record.measurement for record in records[:200]]
    common_m = result["offsets_m"]["101-1"]
    # Half of the estimate: the radios have an offset of 0.22 m, and 0.28 m were added on average.
    assert common_m == pytest.approx(0.25, abs=0.07)
    for before, after in zip(
        Mitigation(UNIVERSAL).correct(measured), with_offset.correct(measured), strict=True
    ):
        assert after.range_m == pytest.approx(before.range_m - common_m, abs=1e-4)
        assert after.variance_m2 == before.variance_m2


def test_reference_of_ranges_does_not_depend_on_what_is_subtracted(monkeypatch):
    source = SimulatedSource.with_anchors(5, seed=4, count=400, rate_hz=20.0)
    site = read_site([list(source)], source.anchors, UNIVERSAL)
    estimate, estimated, mae_m = solution_module.self_calibrate, {}, []

    def estimate_once(anchors, tags, *given, **options):
        key = tags[0].stamp_ns.tobytes() + tags[0].range_m.tobytes()
        if key not in estimated:
            estimated[key] = estimate(anchors, tags, *given, **options)
        return estimated[key]

    monkeypatch.setattr(solution_module, "self_calibrate", estimate_once)
    for share in (0.5, 1.0):
        monkeypatch.setattr(solution_module, "SUBTRACTED_SHARE", share)
        solution = solve_without_truth(site, height=Height(0.0), area=None)
        mae_m.append(calibrate_site(site, UNIVERSAL, solution).mae_m)
    for name in ("raw", "shipped model alone"):
        assert mae_m[0][name] == pytest.approx(mae_m[1][name], abs=1e-6)


def test_with_cirs_half_of_the_differences_of_true_offsets_is_subtracted():
    """What the network leaves behind walls depends on the drive."""
    source = SimulatedSource.with_anchors(5, seed=4, count=600, rate_hz=20.0)
    records = list(source)
    site = read_site([records], source.anchors, UNIVERSAL)
    stamp_ns = np.array([record.measurement.stamp_ns for record in records])
    path = TruePath(stamp_ns, np.array([record.tag_position for record in records]))
    localisation = replace(poses := localisation_of(path), paths={site.tags[0].tag_id: poses.paths[7]})
    solution = solve_with_truth(site, localisation)
    values = np.array([value for value, _ in solution.pairs.values()])
    assert np.ptp(values) > 0.02
    subtracted = np.array([value for value, _ in solution.subtracted("pair").values()])
    assert subtracted == pytest.approx(0.5 * (values + solution.common_m))


def test_levels_correct_ranges_of_other_radios_with_truth(tmp_path):
    """NLOS makes simulated STS ranges longer by 0.06 m per dB between receive and first-path level."""
    kind = {"radio": RadioType.DW3000, "segment": Segment.STS, "channel": 9}

    def measure(seed):
        ranges, path = drive(SITE, seconds=80, rate_hz=10.0, offset_m=0.0)
        rng, n = np.random.default_rng(seed), len(ranges)
        nlos = (rng.random((41, 7)) < 0.3)[ranges.stamp_ns // 2_000_000_000, ranges.anchor]
        gap = np.where(nlos, rng.normal(12, 2, n), rng.normal(3.5, 1, n))
        level = -80 - rng.normal(0, 3, n) - 3 * nlos
        value = ranges.range_m + OWN[ranges.anchor] + 0.06 * np.maximum(gap - 5, 0)
        return list(records_of(ranges, level, value, gap, **kind)), ranges.range_m, path

    records, _, path = measure(1)
    calibration = calibrated(records, path)
    assert calibration.chosen == "offsets + line"
    bundle, _ = calibration.write(tmp_path / "site.onnx", UNIVERSAL, "drive")
    assert bundle.card.channels == (9,)
    # Another drive, with other walls.
    held_out, true_m, _ = measure(2)
    corrected = Mitigation(bundle, calibration.offsets).correct([record.measurement for record in held_out])
    assert {each.status for each in corrected} == {Status.OK}
    offsets_m = np.array([calibration.pairs[7, record.measurement.anchor_id][0] for record in held_out])
    only_offsets_m = np.abs([record.measurement.range_m for record in held_out] - offsets_m - true_m).mean()
    assert np.abs([each.range_m for each in corrected] - true_m).mean() < 0.7 * only_offsets_m
