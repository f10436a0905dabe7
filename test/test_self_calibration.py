"""Offsets, lines and positions estimated from ranges only; synthetic geometry with known truth."""

import re
from dataclasses import replace

import numpy as np
import pytest
from drives import HALL, anchors_at, circuit, drive

from uwb_mitigation.calibration.hypotheses import AnchorHypotheses
from uwb_mitigation.calibration.motion_segments import find_segments
from uwb_mitigation.calibration.pose_alignment import align_poses
from uwb_mitigation.calibration.regression import SLOPE_SD, Regressors
from uwb_mitigation.calibration.self_calibration import self_calibrate
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.tracks import PosePath, Ranges

LEVEL = Height(1.0)
OWN = np.array([0.2, -0.1, 0.05, -0.2, 0.05])


def distances(path, ranges):
    return np.linalg.norm(path.position - HALL.position[ranges.anchor], axis=1)


def level_poses(stamp_ns, position):
    """Return poses without turns."""
    return PosePath(stamp_ns, position, np.tile([0.0, 0.0, 0.0, 1.0], (len(stamp_ns), 1)))


def with_own(ranges: Ranges, own=OWN) -> Ranges:
    return replace(ranges, range_m=ranges.range_m + own[ranges.anchor])


@pytest.fixture(scope="module")
def recorded():
    return drive(seconds=80, rate_hz=10.0, offset_m=0.25)


def test_pseudo_truth_uses_the_other_anchors_and_has_a_standard_deviation(recorded):
    ranges, path = recorded
    truth = distances(path, ranges)
    solved = self_calibrate(HALL, [with_own(ranges)], height=LEVEL)
    assert [solved.pair(0, row)[0] for row in range(5)] == pytest.approx(OWN + 0.25, abs=0.12)
    error = solved.distance_m - truth
    assert np.isfinite(error).all()
    assert np.abs(error).mean() < 0.1
    assert 0.3 < np.sqrt(np.mean((error / solved.distance_sd_m) ** 2)) < 2.0
    # Ranges of the anchor itself are not used: wrong ones do not move the tag.
    changed = with_own(ranges, np.array([0.0, 0.0, 0.35, 0.0, 0.0]))
    again = self_calibrate(HALL, [changed], height=LEVEL)
    own = ranges.anchor == 2
    assert np.abs(again.distance_m - truth)[own].mean() < 0.15


def test_ranges_with_larger_errors_have_lower_weights(recorded):
    ranges, _ = recorded
    # Behind walls, half of the predicted error remains; anchors at one side are affected more often.
    rng = np.random.default_rng(8)
    blocked = rng.random(len(ranges)) < np.array([0.8, 0.1, 0.1, 0.8, 0.4])[ranges.anchor]
    late = with_own(ranges, OWN).range_m + np.where(blocked, np.abs(rng.normal(0.0, 0.4, len(ranges))), 0.0)
    changed = replace(ranges, range_m=late)
    predicted = Regressors.single("network", np.zeros(len(ranges)), 1.0, 0.03)

    def worst(noise_group):
        found = self_calibrate(HALL, [changed], replace(predicted, noise_group=noise_group), height=LEVEL)
        return np.abs([found.pair(0, row)[0] - 0.25 - OWN[row] for row in range(5)]).max()

    assert worst(blocked.astype(int)) < 0.07 < worst(predicted.noise_group)


def test_carried_tag_at_16_positions_determines_offset_and_ranges():
    """128 links to 24 anchors, 35 % of them behind obstacles that also reduce the power; a pause between positions."""
    rng = np.random.default_rng(1)
    where = np.column_stack([rng.uniform(0, 40, 24), rng.uniform(0, 25, 24), rng.uniform(2, 5, 24)])
    anchors = anchors_at(where, 0.02)
    placements, truth = [], []
    for number in range(16):
        distance = np.linalg.norm(where - [rng.uniform(3, 37), rng.uniform(3, 22), 1.0], axis=1)
        row = np.sort(np.argsort(distance)[:8])
        obstacle_m = np.where(rng.random(8) < 0.35, rng.exponential(0.45, 8), 0.0)
        power = -80 - 20 * np.log10(distance[row] / 5) + rng.normal(0, 2, 8) - 10 * obstacle_m
        range_m = distance[row] + 0.12 + obstacle_m + rng.normal(0, 0.05, 8)
        stamp = np.arange(8) * 10**8 + number * 60 * 10**9
        placements.append(Ranges(stamp, row, range_m, np.full(8, np.nan), power))
        truth.append(distance[row])
    carried = Ranges.of_tags(placements)
    power = Regressors.single("level", carried.rx_power_dbm - np.median(carried.rx_power_dbm), 0.0, SLOPE_SD)
    found = self_calibrate(anchors, [carried], power, height=LEVEL)
    assert found.segments.is_stationary.tolist() == [True] * 16
    observations = found.fit.observations
    corrected = carried.range_m - (observations.rows @ found.fit.parameters)[observations.observation_index]
    raw_mae, mae = (np.abs(value - np.concatenate(truth)).mean() for value in (carried.range_m, corrected))
    assert mae < 0.85 * raw_mae
    # Obstacles do not look like a wrong height, nor does a wrong height look like obstacles.
    refused("height of 2.5 m contradicts", anchors, [carried], regressors=power, height=Height(2.5))


@pytest.mark.parametrize("rate_hz", [40.0, 1.0])
def test_drive_without_stops_has_no_stationary_segments(rate_hz):
    ranges, _ = drive(seconds=120, rate_hz=rate_hz)
    assert not find_segments([ranges]).is_stationary.any()


def test_noisy_localisation_is_smoothed_and_keeps_its_turns():
    rng = np.random.default_rng(3)
    stamp = np.arange(1200) * 25_000_000 + rng.integers(0, 10_000_000, 1200)
    true = circuit(stamp / 1e9 * 3.0)
    rough = level_poses(stamp, true + rng.normal(0, 0.02, true.shape))
    left = rough.smoothed().position - true
    assert np.abs(left.mean(axis=0)).max() < 0.002
    assert left.std() < 0.012
    # Too few poses for a parabola are left unchanged.
    few = level_poses(rough.stamp_ns[::10], rough.position[::10])
    assert (few.smoothed().position == few.position).all()


def test_stationary_segment_of_a_drive_is_one_position():
    def path(time_s):
        return circuit(np.minimum(time_s, 20.0) + np.maximum(time_s - 40.0, 0.0))

    ranges, _ = drive(seconds=60, rate_hz=25.0, path=path, model=NoiseModel(range_sd=0.02))
    found = find_segments([ranges])
    assert found.is_stationary.tolist() == [False, True, False]
    stationary = found.ranges.stamp_ns[found.segment == 1] / 1e9
    assert stationary[0] == pytest.approx(20.0, abs=2.0)
    assert stationary[-1] == pytest.approx(40.0, abs=2.0)


def refused(match, anchors, tags, **options):
    with pytest.raises(DatasetError, match=match):
        self_calibrate(anchors, tags, **options)


def test_unobservable_calibration_is_refused(recorded):
    ranges = recorded[0]
    refused("3 anchors were received", HALL, [ranges.take(ranges.anchor < 3)], height=LEVEL)
    refused("4 anchors were received", HALL, [ranges.take(ranges.anchor < 4)])
    refused("on a line", HALL.moved(HALL.position * (1, 0, 0), HALL.sd), [ranges], height=LEVEL)
    refused("in a plane", HALL.moved(HALL.position * (1, 1, 0), HALL.sd), [ranges])
    still, _ = drive(seconds=30, rate_hz=25.0, path=lambda t: circuit(0 * t))
    refused("moves by", HALL, [still], height=LEVEL)
    refused("too few", HALL, [ranges.take(ranges.stamp_ns < 6 * 10**9)], height=LEVEL)
    feet = replace(ranges, range_m=ranges.range_m / 0.3048)
    refused("if the ranges were in feet", HALL, [feet], height=LEVEL)


def test_track_with_two_mirror_images_is_refused():
    # The anchors are almost in a plane and the tag is 0.5 m below it: 0.5 m above fits equally well.
    flat = HALL.position.copy()
    flat[:, 2] = (1.1, 1.9, 1.1, 1.9, 1.5)
    ranges, _ = drive(
        HALL.moved(flat, HALL.sd), seconds=40, rate_hz=25.0, seed=3, model=NoiseModel(range_sd=0.3)
    )
    refused("mirror images", HALL.moved(flat, HALL.sd), [ranges])


@pytest.mark.parametrize(
    ("rows", "places", "named"),
    [
        ([3], (3.0, 6.5, 0.5), "anchor 4 contradicts"),
        ([4], (7.5, 0.0, 1.5), "anchor 5 contradicts"),
        ([0, 2], HALL.position[[2, 0]], "anchors 1 and 3 contradict"),
    ],
)
def test_anchors_at_wrong_positions_are_named_by_their_ids(recorded, rows, places, named):
    position = HALL.position.copy()
    position[rows] = places
    # Each anchor has 20 independent errors.
    ranges = recorded[0].take(recorded[0].stamp_ns < 40 * 10**9)
    refused(named, HALL.moved(position, HALL.sd), [ranges], height=LEVEL)


def test_four_anchors_show_a_displacement_that_the_track_follows():
    def notes(swing_m, wrong_m):
        def weave(time_s):
            swing = np.stack([np.cos(0.2 * time_s), np.sin(0.31 * time_s)], axis=1) * swing_m
            return np.insert(np.add(swing, (6.0, 4.5)), 2, 1.0, axis=1)

        ranges, _ = drive(seconds=120, rate_hz=10.0, path=weave)
        ranges = ranges.take(ranges.anchor < 4)
        predicted = Regressors.single("network", np.zeros(len(ranges)), 1.0, 0.03)
        wrong = HALL.position + np.outer(np.arange(5) == 2, (*wrong_m, 0.0))
        return self_calibrate(HALL.moved(wrong, HALL.sd), [ranges], predicted, height=LEVEL).notes

    assert not notes((5.0, 4.0), (0.0, 0.0))
    (note,) = notes((5.0, 4.0), (0.5, -0.6))
    fits = re.match(
        r"anchor 3 may be displaced: .* x = (.*) m, y = (.*) m \(.* deviation (.*) m\), 0.9 m", note
    )
    assert fits, note
    x, y, sd = map(float, fits.groups())
    assert (x, y) == pytest.approx(HALL.position[2, :2], abs=0.3)
    assert 0.1 < sd < 0.4
    # Along a line, offsets of the anchors explain the same ranges.
    (note,) = notes((4.0, 0.5), (0.5, -0.6))
    assert re.match(r"a position of anchor . that is wrong by up to 0.9 m is not noticed", note), note


def test_positions_of_a_carried_tag_without_pauses_are_refused():
    rng = np.random.default_rng(1)
    row = np.tile(np.arange(5), 3 * 12)
    position = np.repeat(rng.uniform((1, 1, 1), (11, 8, 1), (12, 3)), 15, axis=0)
    distance = np.linalg.norm(HALL.position[row] - position, axis=1) + rng.normal(0, 0.03, len(row))
    unknown = np.full(len(row), np.nan)
    carried = Ranges(np.arange(len(row)) * 10**8, row, distance, unknown, unknown)
    refused("contradict the estimated track", HALL, [carried], height=LEVEL)


@pytest.mark.parametrize(
    ("blocked", "longer_m", "axis", "beyond_m", "seconds"),
    [
        # Large errors are outliers: with squared errors, a displacement by 7.8 m explains 84 % of the misfit.
        pytest.param([3], 4.0, 1, -5.5, 80.0, id="large errors"),
        # A displacement by 2.9 m increases the likelihood by e^51, but explains 57 % of the misfit only.
        pytest.param([3], 2.0, 0, 6.0, 80.0, id="a part of the misfit"),
        # Each of two anchors explains 74 % of its misfit, but neither stands out.
        pytest.param([0, 3], 4.0, 0, 6.0, 80.0, id="two anchors"),
        # A displacement by 1.1 m explains 67 % of few independent errors: by chance with a probability of e^-11.
        pytest.param([3], 0.75, 0, 4.0, 20.0, id="a short drive"),
    ],
)
def test_obstacle_accuses_no_anchor(recorded, blocked, longer_m, axis, beyond_m, seconds):
    """It lengthens the ranges of anchors on one side of the hall: x below, or y above a limit."""
    ranges, path = (part.take(recorded[0].stamp_ns < seconds * 1e9) for part in recorded)
    is_behind = path.position[:, axis] * np.sign(beyond_m) < beyond_m
    longer = np.where(is_behind & np.isin(ranges.anchor, blocked), longer_m, 0.0)
    hypotheses = AnchorHypotheses(HALL, replace(ranges, range_m=ranges.range_m + longer), path.position)
    hypotheses.check("the others", is_independent=False)


def test_slow_errors_outside_of_the_anchors_leave_the_common_offset_unknown():
    """There, errors that persist for 20 s move the estimate of the offset by 0.7 m."""
    near = HALL.moved(HALL.position * (0.25, 0.25, 1.0) + (4.5, 3.5, 0.0), HALL.sd)

    def around(time_s):
        return circuit(time_s) * (2.0, 2.0, 1.0) - (6.0, 4.5, 0.0)

    ranges, _ = drive(
        near, seconds=90, rate_hz=12.5, offset_m=0.0, path=around, model=NoiseModel(range_sd=0.03)
    )
    slow = np.random.default_rng(1).normal(0.0, 0.07, (5, 10))
    late = slow[ranges.anchor, ranges.stamp_ns // 20_000_000_000]
    value, sd = self_calibrate(near, [replace(ranges, range_m=ranges.range_m + late)], height=LEVEL).mean()
    assert abs(value) < 2.0 * sd
    assert sd > 0.3


def test_anchor_with_one_range_has_a_large_standard_deviation(recorded):
    ranges = with_own(recorded[0])
    few = np.isin(np.arange(len(ranges)), np.flatnonzero(ranges.anchor == 4)[:1])
    found = self_calibrate(HALL, [ranges.take(few | (ranges.anchor != 4))], height=LEVEL)
    pairs = np.array([found.pair(0, row) for row in range(5)])
    assert pairs[4, 1] > 1.5 * pairs[:4, 1].max()
    assert np.abs((pairs[:, 0] - 0.25 - OWN) / pairs[:, 1]).max() < 3.0


def test_area_excludes_the_mirror_image_in_a_plane():
    flat = HALL.moved(HALL.position * (1, 1, 0) + (0, 0, 2.5), HALL.sd)
    ranges, _ = drive(flat, seconds=100, rate_hz=10.0, offset_m=0.4)
    found = self_calibrate(flat, [ranges], area=Area((-1.0, -1.0, 0.0), (13.0, 10.0, 2.0)))
    assert found.pair(0, 0)[0] == pytest.approx(0.4, abs=0.06)
    assert found.fit.position[:, 2].max() < 2.5


def turning(path, lever, late_ns=0):
    """Return poses of a turning robot with an antenna at `lever`."""
    heading = 0.7 * path.stamp_ns / 1e9
    c, s, zero = np.cos(heading), np.sin(heading), np.zeros(len(path))
    off = np.stack([c * lever[0] - s * lever[1], s * lever[0] + c * lever[1], zero + lever[2]], axis=1)
    quaternion = np.stack([zero, zero, np.sin(heading / 2), np.cos(heading / 2)], axis=1)
    return PosePath(path.stamp_ns + late_ns, path.position - off, quaternion)


def test_time_offset_is_given_or_within_the_localisation_and_the_arm_needs_turns(recorded):
    ranges, path = recorded
    lever = np.array([0.3, -0.25, 0.0])
    late = turning(path, lever, 300_000_000)
    nothing = Regressors.none(len(ranges))
    given = align_poses(HALL, [ranges], [late], nothing, time_offset_s=0.3, lever_arms_m=lever[None])
    assert (given.time_offset_s, given.time_offset_sd_s) == (pytest.approx(0.3, abs=1e-6), 0.0)
    with pytest.raises(DatasetError, match="time span of the localisation"):
        align_poses(HALL, [ranges], [late.shifted(10**13)], nothing)
    short, nothing = ranges.take(ranges.stamp_ns < 10**10), Regressors.none(100)
    poses = [level_poses(path.stamp_ns, path.position)]
    with pytest.raises(DatasetError, match="cannot be separated"):
        align_poses(HALL, [short], poses, nothing, time_offset_s=0.0, estimate_lever_arm=True)


def test_each_tag_has_its_own_lever_arm_and_its_own_body(recorded):
    ranges, path = recorded
    arms = np.array([[0.4, 0.0, 0.0], [-0.3, 0.2, 0.0]])
    other, _ = drive(seconds=80, rate_hz=10.0, offset_m=0.25, seed=5)
    bodies = [turning(path, arms[0]), turning(path, arms[1])]
    tags = [ranges, replace(other, tag_id=8)]
    nothing = Regressors.none(sum(map(len, tags)))
    found = align_poses(HALL, tags, bodies, nothing, time_offset_s=0.0, estimate_lever_arm=True)
    assert np.abs(found.lever_arm_m - arms)[:, :2].max() < 0.05
    assert np.abs(found.offset_m - 0.25).max() < 0.08
    truth = distances(path, ranges)
    known = np.isfinite(found.distance_m)
    assert np.abs(found.distance_m - np.tile(truth, 2))[known].max() < 0.1


def test_two_standard_deviations_cover_the_errors_of_time_offset_and_lever_arm():
    lever, error, sd = np.array([0.3, -0.2, 0.0]), [], []
    for seed in range(5):
        ranges, path = drive(seconds=60, rate_hz=20.0, seed=seed, offset_m=0.2)
        # The localisation drifts by 4 cm within about 10 s.
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
        time_s = path.stamp_ns[:, None] / 1e9
        drift = np.column_stack([0.04 * np.sin(0.6 * time_s + phase), np.zeros(len(path))])
        pose = turning(replace(path, position=path.position + drift), lever, 300_000_000)
        found = align_poses(HALL, [ranges], [pose], Regressors.none(len(ranges)), estimate_lever_arm=True)
        error += [found.time_offset_s - 0.3, *(found.lever_arm_m[0] - lever)[:2]]
        sd += [found.time_offset_sd_s, *found.lever_arm_sd_m[0, :2]]
    assert (np.abs(error) <= 2.0 * np.array(sd)).mean() >= 0.9


def test_measured_heights_replace_a_constant_one():
    def up_and_down(time_s):
        return circuit(time_s) + np.stack([0 * time_s, 0 * time_s, np.sin(0.5 * time_s)], axis=1)

    ranges, path = drive(seconds=60, rate_hz=10.0, offset_m=0.25, path=up_and_down)
    truth = distances(path, ranges)
    measured, uncertain = (
        self_calibrate(HALL, [ranges], heights_m=path.position[:, 2], height_sd_m=sd) for sd in (0.1, 0.5)
    )
    assert np.median(uncertain.distance_sd_m) > 1.2 * np.median(measured.distance_sd_m)
    constant = self_calibrate(HALL, [ranges], height=LEVEL)
    assert measured.pair(0, 0)[0] == pytest.approx(0.25, abs=0.06)
    wrong = [np.median(np.abs(one.distance_m - truth)) for one in (measured, constant)]
    assert wrong[0] < 0.06 < wrong[1]
