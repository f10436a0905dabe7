"""The filter, its initialisation, and relocalisation of a lost tag."""

import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drives import HALL, NANOSECONDS, WALL, anchors_at, block, circuit, drive, flight
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.position_data import load_geometry, simulated_runs
from benchmarks.positions import ambiguous_drives, evaluate, locate
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.determination import current_determination, determination, drive_determination
from uwb_mitigation.positioning.geometry import (
    Area,
    Height,
    constant_error_gain,
    dop,
    extents,
    horizontal_ellipse,
)
from uwb_mitigation.positioning.multi_tag import MultiTagEstimator
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.ambiguity import Ambiguity, AmbiguityCheck
from uwb_mitigation.positioning.online.filter import FIRST_ERROR, OFFSET, RangeFilter
from uwb_mitigation.positioning.online.initialization import candidate_positions, snapshot
from uwb_mitigation.positioning.online.measurements import TagRange
from uwb_mitigation.positioning.online.robust_update import CONSTANT_SD, CORRECTED_WHITE, MAX_CONSTANT
from uwb_mitigation.positioning.online.tag_estimator import RANGE_TIMEOUT_S, TagEstimator
from uwb_mitigation.positioning.residual_directions import ResidualDirections, displaced_anchor
from uwb_mitigation.positioning.track_errors import errors_of, track_errors
from uwb_mitigation.types.anchors import SD_M, AnchorMap
from uwb_mitigation.types.tracks import Estimate, Heights, Ranges, Track, TruePath

PLAIN = NoiseModel(long=100.0, short=100.0)
"""No range is down-weighted."""

FLAT = WALL.moved(WALL.position * (1, 1, 0) + np.outer([0, 0, -3, -3, 0], (1, 0, 0)) + (0, 0, 2), WALL.sd)
"""Anchors in one plane: without a height, every position has a mirror image."""
FLAT_HALL = HALL.moved(HALL.position * (1, 1, 0) + (-6, -4.5, 2), HALL.sd)

SLOPE = anchors_at([(8, -3, 6), (8, 3, 6), (9, -3, 6.5), (9, 3, 6.5), (8.5, 0, 6.2)], 0.03)
"""Anchors high on one side: errors of the height and in plan are strongly correlated."""


def test_filter_agrees_with_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    own_filter = RangeFilter(HALL, PLAIN, 0.0, np.array([6.0, 4.0, 1.0]), np.eye(3))
    own_filter.state.estimates_errors = True
    constant = len(own_filter.x)
    n = constant + len(HALL)
    filterpy_filter = kalman.ExtendedKalmanFilter(dim_x=n, dim_z=1)
    filterpy_filter.x = np.pad(own_filter.x, (0, len(HALL)))[:, None]
    filterpy_filter.P = np.pad(own_filter.P, (0, len(HALL)))
    filterpy_filter.P[range(constant, n), range(constant, n)] = CONSTANT_SD**2
    ranges, _ = drive(seconds=3)
    variance = PLAIN.range_sd**2
    claimed = np.diag(filterpy_filter.P)[FIRST_ERROR:constant].copy()
    previous = 0.0
    for stamp, row, range_m in zip(ranges.stamp_ns / 1e9, ranges.anchor, ranges.range_m, strict=True):
        dt, previous = stamp - previous, stamp
        kept = math.exp(-dt / PLAIN.persistence_s)
        f, q = np.eye(n), np.zeros((n, n))
        f[range(FIRST_ERROR, constant), range(FIRST_ERROR, constant)] = kept
        q[range(FIRST_ERROR, constant), range(FIRST_ERROR, constant)] = (1 - kept**2) * claimed
        for axis in range(3):
            f[axis, axis + 3] = dt
            block = np.ix_([axis, axis + 3], [axis, axis + 3])
            q[block] = PLAIN.acceleration**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        filterpy_filter.F, filterpy_filter.Q = f, q
        filterpy_filter.predict()

        def slope(x, row=row):
            away = x[:3, 0] - HALL.position[row]
            h = np.zeros((1, n))
            h[0, :3] = away / np.linalg.norm(away)
            h[0, [OFFSET, FIRST_ERROR + row, constant + row]] = 1
            return h

        def expected(x, row=row):
            distance = np.linalg.norm(x[:3, 0] - HALL.position[row])
            return distance + x[OFFSET] + x[FIRST_ERROR + row] + x[constant + row]

        white = max(CORRECTED_WHITE * variance, variance - claimed[row])
        distance = np.linalg.norm(filterpy_filter.x[:3, 0] - HALL.position[row])
        white += 0.5 * (np.trace(filterpy_filter.P[:2, :2]) / distance) ** 2
        filterpy_filter.update(np.array([[range_m]]), slope, expected, R=np.array([[white]]))
        claimed[row] += 0.1 * ((1 - CORRECTED_WHITE) * variance - claimed[row])
        own_filter.predict(stamp)
        own_filter.update(row, range_m, variance, True)
        np.testing.assert_allclose(own_filter.x, filterpy_filter.x[:, 0], atol=1e-8)
    np.testing.assert_allclose(own_filter.P, filterpy_filter.P, atol=1e-8)


def test_constant_errors_of_corrected_ranges_are_estimated():
    ranges, truth = drive(seconds=60)
    ranges.range_m[:] += np.array([0.2, -0.2, 0.2, -0.2, 0.0])[ranges.anchor]
    with_variance = TagEstimator(EstimatorConfig(HALL, height=Height(1.0)))
    without = TagEstimator(EstimatorConfig(HALL, height=Height(1.0)))
    raw = replace(ranges, is_corrected=False)
    last = slice(len(ranges) // 2, None)
    corrected_rmse = track_errors(with_variance.run(ranges).take(last), truth).rmse
    assert corrected_rmse < 0.8 * track_errors(without.run(raw).take(last), truth).rmse


def test_corrections_that_are_wrong_behind_thin_walls_hardly_change_positions():
    ranges, truth = drive(seconds=60)
    is_uncertain = block(replace(ranges, range_m=np.zeros(len(ranges)))).range_m > 0.0
    variance_m2 = np.where(is_uncertain, 0.2**2, ranges.variance_m2)
    late, errors = truth.take(truth.stamp_ns > 20 * NANOSECONDS), {}
    for error_m in (0.0, -0.2):
        wrong = replace(ranges, range_m=ranges.range_m + error_m * is_uncertain, variance_m2=variance_m2)
        live = TagEstimator(EstimatorConfig(HALL, height=Height(1.0))).run(wrong)
        errors[error_m] = track_errors(live, late).rmse
    assert errors[-0.2] < 1.15 * errors[0.0]


@pytest.mark.parametrize(
    "errors_m",
    [
        (0.6, -0.8, 0.1, -0.2, -0.1, -0.1, -0.6, -0.1),
        (0.5, 0.3, 0.4, -0.4, 0.3, -0.1, -0.1, 0.4),
        (0.2, -0.2, 0.2, 0.0, -0.6, 0.4, 0.0, 0.2),
    ],
)
def test_constant_errors_of_raw_ranges_do_not_make_the_filter_follow_a_few_anchors(errors_m):
    corners = anchors_at([(x, y, z) for x in (0.0, 12.0) for y in (0.0, 9.0) for z in (0.3, 2.5)])
    ranges, truth = drive(corners, rate_hz=80.0, seed=3)
    ranges.range_m[:] += np.array(errors_m)[ranges.anchor]
    raw, height = replace(ranges, is_corrected=False), Height(1.0)
    locator = TagEstimator(EstimatorConfig(corners, height=height))
    live = locator.run(raw)
    late = truth.take(truth.stamp_ns > 20 * NANOSECONDS)
    assert track_errors(live, late).rmse < 1.1 * track_errors(snapshot(corners, raw, height), late).rmse
    assert locator.raw_factor > 1.5
    three = raw.take(raw.anchor < 3)
    locator.run(replace(three, stamp_ns=three.stamp_ns + 60 * NANOSECONDS))
    assert locator.raw_factor == 1.0, "three anchors do not show constant errors"


@pytest.mark.parametrize("seed", [0, 3])
def test_ellipses_follow_the_errors_of_ranges(tmp_path: Path, seed: int):
    errors = {"common": 0.0, "constant": 0.2, "slow": 0.2, "length": 3.0, "white": 0.1, "nlos": 0.2}
    sides = [(0.2, 2, 0), (2.8, 0, 0), (14.2, 0, 0), (7.5, 2, 0), (20, 2, 0), (12.4, 0, 0), (5.6, 0, 0)]
    space = {"low": [-2.0, -0.5, 1.2], "high": [22.0, 2.5, 1.2], "speed": 2.0}
    corridor = {"name": "corridor", "anchors": sides, "tag": space, "errors": errors, "rate_hz": 20.0}
    (tmp_path / "layouts.yaml").write_text(json.dumps({"geometries": [corridor]}))
    run = load_geometry("", "", str(tmp_path / "layouts.yaml"), "corridor", 2, seed, 60.0)
    late = run.truth.take(run.truth.stamp_ns > run.ranges.stamp_ns[0] + 10 * NANOSECONDS)
    assert track_errors(locate(run, run.ranges), late).coverage95 > 0.85


def test_number_of_constant_errors_is_bounded():
    anchors = anchors_at((n, 5 * (n % 2), 2) for n in range(1, MAX_CONSTANT + 5))
    own_filter = RangeFilter(anchors, PLAIN, 0.0, np.zeros(3), np.eye(3))
    for time_s, row in enumerate([*range(len(anchors))] * 2):
        own_filter.predict(0.1 * time_s)
        own_filter.update(row, float(np.linalg.norm(anchors.position[row])), 0.01, True)
    assert len(own_filter.x) == FIRST_ERROR + len(anchors) + MAX_CONSTANT
    # The latest ones have a state each.
    latest = own_filter.state._constant_rows
    assert list(latest) == list(range(4, len(anchors)))
    assert len(set(latest.values())) == MAX_CONSTANT
    assert np.linalg.eigvalsh(own_filter.P).min() > -1e-9


@settings(max_examples=40)
@given(
    steps=st.lists(
        st.tuples(st.floats(0, 2), st.integers(0, 4), st.floats(0, 60), st.floats(1e-4, 10)),
        min_size=1,
        max_size=60,
    ),
    estimates_errors=st.booleans(),
)
def test_covariance_stays_valid_and_the_state_finite(steps, estimates_errors: bool):
    one = RangeFilter(HALL, NoiseModel(), 0.0, np.array([6.0, 4.0, 1.0]), np.eye(3))
    one.state.estimates_errors = estimates_errors
    now = 0.0
    for dt, row, range_m, variance in steps:
        now += dt
        one.predict(now)
        one.update(row, range_m, variance, variance > 0.01)
    np.testing.assert_allclose(one.P, one.P.T, atol=1e-9 * np.abs(one.P).max())
    assert np.linalg.eigvalsh((one.P + one.P.T) / 2).min() > -1e-9 * np.abs(one.P).max()
    assert np.isfinite(one.x).all()


def test_covariances_of_live_estimates_are_consistent():
    found = []
    for seed in range(6):
        offset = np.random.default_rng(seed).normal(0, NoiseModel().offset_sd)
        ranges, truth = drive(seconds=25, seed=seed, offset_m=offset, model=NoiseModel(white=CORRECTED_WHITE))
        ranges.range_m[:] += np.random.default_rng(seed).normal(0, CONSTANT_SD, len(HALL))[ranges.anchor]
        errors = track_errors(TagEstimator(EstimatorConfig(HALL)).run(ranges), truth)
        assert errors.rmse < 0.25
        found.append(errors)
    assert 0.5 < np.mean([e.nees_per_dof for e in found]) < 1.5
    assert np.mean([e.coverage95 for e in found]) > 0.88
    assert np.mean([e.exceeded for e in found]) < 0.01


@pytest.mark.parametrize("anchors", [2, 3])
def test_ambiguous_position_is_not_published_until_an_area_resolves_it(anchors: int):
    wall = anchors_at((5 * number, 0, 1) for number in range(anchors))
    ranges, truth = drive(wall, seconds=8)
    locator = TagEstimator(EstimatorConfig(wall, height=Height(1.0)))
    assert len(locator.run(ranges)) == 0
    assert locator.candidates == 2
    inside = TagEstimator(EstimatorConfig(wall, height=Height(1.0), area=Area((-50, 0.1, 0), (50, 50, 3))))
    assert track_errors(inside.run(ranges), truth).rmse < 0.4


SQUARE = anchors_at([(-4, -3, 1.5), (4, -3, 1.52), (4, 3, 1.5), (-4, 3, 1.48)], SD_M)
"""Anchors at one height: their ranges do not show whether a tag is above or below it."""


def around(time_s: np.ndarray) -> np.ndarray:
    return np.stack([2 * np.cos(0.3 * time_s), 2 * np.sin(0.3 * time_s), 2.5 + 0 * time_s], axis=1)


@pytest.mark.parametrize("area", [None, Area((-9, -9, 1.45), (9, 9, 3.5))])
def test_level_anchors_give_x_and_y_and_a_variance_of_the_height_that_contains_the_image(area: Area | None):
    ranges, truth = drive(SQUARE, path=around, seconds=30)
    locator = TagEstimator(EstimatorConfig(SQUARE, area=area))
    errors = track_errors(locator.run(ranges), truth)
    assert errors.epochs > 0.9 * len(ranges)
    assert errors.rmse < 0.2
    if area is None:
        assert locator.images.ambiguity is Ambiguity.HEIGHT
        assert errors.height_exceeded < 0.01


UPRIGHT = np.array([[0, 0, 0.5], [0, 0, 1.5], [0, 0.05, 2.5], [0, 0, 3]])
LINE = UPRIGHT[:, [2, 0, 1]] + (0, 0, 1)
STANDING = FLAT.position[:, [2, 1, 0]]


@pytest.mark.parametrize(
    ("anchors", "position", "ambiguity", "dims", "state", "remedy"),
    [
        (HALL.position, (6, 4, 1), Ambiguity.NONE, 3, "unique", "$"),
        (SQUARE.position, (1, 0, 2.5), Ambiguity.HEIGHT, 3, "mirrored height", "the height.*1.5.*another"),
        (STANDING, (5, 1, 1), Ambiguity.MIRROR, 3, "mirrored position", "an area on one side"),
        (LINE, (1, 2, 1), Ambiguity.MIRROR, 2, "mirrored position", "an area on one side.*line.*another"),
        (LINE, (1, 2, 1), Ambiguity.ARC, 3, "arc", "the height of the tag and an area on one side"),
        (LINE, (1, 2, 1), Ambiguity.CIRCLE, 3, "circle", "the height of the tag and an area on one side"),
        (UPRIGHT, (1, 2, 1), Ambiguity.CIRCLE, 3, "circle", "two more anchors"),
        (HALL.position, (200, 4, 1), Ambiguity.NONE, 2, "weak direction", r"another anchor .*\(0.0, 1.0\)"),
        (HALL.position[:2], None, Ambiguity.NONE, 3, "unknown", "more anchors"),
        (HALL.position, None, Ambiguity.NONE, 3, "unknown", "check the anchors file"),
    ],
)
def test_each_state_names_remedies_for_its_layout(anchors, position, ambiguity, dims, state, remedy):
    place = None if position is None else np.array(position, float)
    found = determination(anchors, place, ambiguity, dims)
    assert found.state == state
    assert re.match(remedy, found.remedy), found.remedy
    assert found.is_unique == (not found.remedy)


def test_one_anchor_that_reads_too_short_does_not_contradict_the_position():
    places = [*HALL.position.tolist(), (0.0, 4.5, 2.0), (12.0, 4.5, 2.0)]
    ranges, _ = drive(anchors_at(places))
    ranges = replace(ranges, range_m=ranges.range_m - 2.0 * (ranges.anchor == 2), is_corrected=False)
    locator = TagEstimator(EstimatorConfig(anchors_at(places), height=Height(1.0, 0.1)))
    assert drive_determination(locator, ranges, locator.run(ranges)).is_unique
    assert not locator.counts["too short"]


def test_first_corrected_range_after_raw_ones_does_not_update_the_error_of_another_anchor():
    located = RangeFilter(HALL, NoiseModel(), 0.0, np.array([5.0, 4.0, 1.0]), np.eye(3))
    for anchor, is_corrected in ((0, False), (1, True)):
        located.update(anchor, 7.0, 0.01, is_corrected)
    assert np.flatnonzero(located.state.H[FIRST_ERROR:]).tolist()[0] == 1


@pytest.mark.parametrize(
    ("order", "is_corrected", "losses"),
    # Swapped at one wall, a mirrored track explains the ranges of three anchors, so that it is never lost.
    [("01234", True, False), ("21034", True, True), ("10234", True, False), ("10234", False, True)],
)
def test_swapped_anchors_are_reported_and_not_drives_past_right_ones(order, is_corrected, losses):
    ranges = replace(drive()[0], is_corrected=is_corrected)
    is_swapped, anchors = order != "01234", HALL.moved(HALL.position[list(map(int, order))], HALL.sd)
    locator = TagEstimator(EstimatorConfig(anchors, height=Height(1.0, 0.1)))
    track = locator.run(ranges)
    found = drive_determination(locator, ranges, track)
    assert (found.state == "contradicted") == is_swapped
    assert bool(locator.counts["contradicted"]) == losses, "also while the variance of raw ranges is wide"
    if not losses:
        assert bool(locator.counts["too short"]) == is_swapped
        assert (np.sqrt(track.covariance[:, 0, 0]).max() > 1.0) == is_swapped
    locator.restart()
    assert not locator.is_contradicted


def test_remedies_for_a_mirrored_height_work():
    ranges, _ = drive(SQUARE, path=around, seconds=30)
    locator = TagEstimator(EstimatorConfig(SQUARE))
    found = drive_determination(locator, ranges, locator.run(ranges))
    assert found.state == "mirrored height"
    floor_m, distance_m = (
        float(re.search(text + " ([0-9.]+) m", found.remedy)[1]) for text in ("z =", "another anchor")
    )
    more = anchors_at([*SQUARE.position, (4, 3, 1.5 + distance_m)], SD_M)
    for anchors, area in ((SQUARE, Area((-9, -9, floor_m), (9, 9, 4))), (more, None)):
        locator = TagEstimator(EstimatorConfig(anchors, area=area))
        ranges, truth = drive(anchors, path=around, seconds=30)
        track = locator.run(ranges)
        assert current_determination(locator).state in ("unique", "weak direction")
        assert track_errors(track, truth).height_rmse < 0.6, "the image is 2 m away"


@pytest.mark.parametrize("seed", [2, 3])
def test_every_position_is_inside_the_area(seed: int):
    area = Area((-4, -4, 0), (0.9, 4, 3))
    ranges, truth = drive(WALL, path=flight, seed=seed)
    locator = TagEstimator(EstimatorConfig(WALL, area=area))
    track = locator.run(block(ranges, seed))
    assert len(track) > 0.9 * len(ranges)
    assert area.holds(track.position).all()
    assert area.holds(locator.predict_at(int(ranges.stamp_ns[-1]) + 5 * NANOSECONDS).position).all()
    errors = track_errors(track, truth)
    assert errors.rmse < 0.6
    assert errors.height_rmse < 0.6


@pytest.mark.parametrize("seed", range(2))
def test_measured_heights_near_the_floor_keep_the_right_solution(seed: int):
    ranges, truth = drive(FLAT, path=flight, seed=seed, seconds=30)
    rng = np.random.default_rng(seed)
    stamps = np.arange(0, 30 * NANOSECONDS, NANOSECONDS // 10)
    height = truth.position_at(stamps)[:, 2] + rng.normal(0, 0.02, len(stamps))
    known = np.isfinite(height)
    heights = Heights(stamps[known], height[known], np.full(known.sum(), 0.0004))
    area = Area((-4, -4, 0), (30, 4, 3))
    live = TagEstimator(EstimatorConfig(FLAT, area=area, heights=heights)).run(ranges)
    smoothed = smooth(EstimatorConfig(FLAT, area=area, heights=heights), ranges, live)
    for track in (live, smoothed):
        assert len(track) > 250
        assert area.holds(track.position).all()
        errors = track_errors(track, truth)
        assert errors.rmse < 0.3
        assert errors.height_rmse < 0.06


@pytest.mark.parametrize(
    ("anchors", "area"), [(FLAT, None), (FLAT_HALL, None), (SLOPE, Area((-30, -30, 0), (30, 30, 7)))]
)
def test_late_heights_correct_a_wrong_height_immediately(anchors: AnchorMap, area: Area | None):
    ranges, truth = drive(anchors, path=flight, seconds=8, seed=2)
    late = truth.stamp_ns > 4 * NANOSECONDS
    heights = Heights(truth.stamp_ns[late], truth.position[late, 2], np.full(late.sum(), 0.0004))
    track = TagEstimator(EstimatorConfig(anchors, area=area, heights=heights)).run(ranges)
    track = track.take(track.stamp_ns > 4.1 * NANOSECONDS)
    assert len(track) > 150
    errors = track_errors(track, truth)
    assert errors.rmse < 0.4
    assert errors.height_rmse < 0.05


def lagged(
    anchors: AnchorMap, ranges: Ranges, truth: TruePath, area: Area | None = None, heights: bool = False
) -> tuple[Track, Track]:
    """Return the live track of a fleet, and the one that is smoothed with a lag."""
    fleet = MultiTagEstimator(EstimatorConfig(anchors, NoiseModel(), area=area))
    live, smoothed = list[Estimate](), list[Estimate]()
    for i in range(len(ranges)):
        range_m = float(ranges.range_m[i])
        found = fleet.add(7, int(ranges.anchor[i]) + 1, int(ranges.stamp_ns[i]), range_m, 0.01)
        tag, estimate = found
        if heights:
            tag.add_height(math.nan, 0.0004)
            tag.add_height(float(truth.position[i, 2]), 0.0004)
        if estimate is not None:
            live.append(estimate)
        if i % 10 == 0 and (late := tag.smoother.estimate()) is not None:
            smoothed.append(late)
    return Track.from_estimates(live), Track.from_estimates(smoothed)


def test_fixed_lag_poses_obey_area_and_measured_heights():
    area = Area((-4, -4, 0), (0.25, 4, 3))
    ranges, truth = drive(WALL, path=flight, seconds=10, seed=2)
    block(ranges, 2)
    tracks = [lagged(WALL, ranges, truth, area, heights)[1] for heights in (False, True)]
    for track in tracks:
        assert len(track) > 30
        assert area.holds(track.position).all()
    without, with_heights = (track_errors(track, truth).height_rmse for track in tracks)
    assert with_heights < 0.03 < without


@pytest.mark.parametrize(
    ("seed", "constant_m"), [(1, (0.0,) * 5), (3, (0.0,) * 5), (1, (0.4, 0.0, 0.1, -0.1, 0.5))]
)
def test_fixed_lag_poses_among_obstacles_are_not_worse_than_live(seed: int, constant_m: tuple[float, ...]):
    ranges, truth = drive(seconds=30, seed=seed)
    block(ranges, seed).range_m[:] += np.array(constant_m)[ranges.anchor]
    live, smoothed = (track_errors(one, truth) for one in lagged(HALL, ranges, truth))
    assert smoothed.rmse < 1.1 * live.rmse
    assert smoothed.coverage95 > max(0.85, live.coverage95 - 0.05)


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("height", [None, Height(1.0)])
def test_anchors_almost_on_a_line_never_decide_by_chance(seed: int, height: Height | None):
    rng = np.random.default_rng(seed)
    line = anchors_at([(2.5 * i, *rng.normal((0, 1), 0.03)) for i in range(1, 6)], 0.03)
    ranges, _ = drive(line, seconds=30, seed=seed)
    block(ranges, seed)
    locator = TagEstimator(EstimatorConfig(line, height=height))
    assert len(locator.run(ranges)) == 0
    assert re.search("within 0.0. m of a line", str(current_determination(locator)))


def test_covariance_grows_in_a_gap_and_the_tag_is_found_within_two_seconds_after_it():
    ranges, truth = drive(seconds=40)
    locator = TagEstimator(EstimatorConfig(HALL))
    locator.run(ranges.take(ranges.stamp_ns < 15 * NANOSECONDS))
    spread = [locator.predict_at((15 + s) * NANOSECONDS).covariance[0, 0] for s in range(10)]
    assert (np.diff(spread) > 0).all()
    assert spread[-1] > 10
    assert RANGE_TIMEOUT_S < 10
    after = locator.run(ranges.take(ranges.stamp_ns >= 25 * NANOSECONDS))
    late = after.take(after.stamp_ns >= 27 * NANOSECONDS)
    assert late.stamp_ns[0] < 27.1 * NANOSECONDS
    errors = track_errors(late, truth)
    assert errors.nees_per_dof < 2
    assert errors.rmse < 0.3


def test_kidnapped_tag_is_found_within_two_seconds():
    def carried(time_s):
        position = circuit(time_s)
        position[time_s >= 20] += (-5.5, 3.0, 0.0)
        return position

    ranges, truth = drive(seconds=40, path=carried)
    locator = TagEstimator(EstimatorConfig(HALL))
    track = locator.run(ranges)
    late = track.take(track.stamp_ns >= 22 * NANOSECONDS)
    assert len(late) > 600
    assert locator.counts["lost"] >= 1
    assert track_errors(late, truth).nees_per_dof < 2


def test_obstacles_in_front_of_half_of_the_anchors_do_not_make_a_tag_lost():
    ranges, truth = drive(SQUARE, path=around, seconds=30)
    blocked = (ranges.anchor < 2) & (np.abs(ranges.stamp_ns / NANOSECONDS - 20) < 0.8)
    ranges.range_m[blocked] += 4.0
    locator = TagEstimator(EstimatorConfig(SQUARE, height=Height(2.5)))
    first = ranges.stamp_ns < 20.7 * NANOSECONDS
    locator.run(ranges.take(first))
    assert locator.disagreeing() == [0, 1]
    assert track_errors(locator.run(ranges.take(~first)), truth).rmse < 0.2
    assert locator.counts["lost"] == 0


def test_invalid_input_is_skipped_and_a_restarted_replay_resets_the_tag():
    ranges, truth = drive(seconds=10)
    locator = TagEstimator(EstimatorConfig(HALL))
    for value in (math.nan, math.inf, -1.0):
        assert locator.add(TagRange(0, 0, value)) is None
    assert locator.add(TagRange(0, 0, 5.0, math.inf)) is None
    locator.run(ranges)
    stamp = int(ranges.stamp_ns[-1])
    assert locator.add(TagRange(stamp - 1000, 0, ranges.range_m[-1])) is not None  # a NumPy scalar
    assert locator.counts["backwards"] == 1
    assert track_errors(locator.run(ranges), truth).rmse < 0.3
    assert locator.counts["found"] == 2


def test_all_candidate_positions_are_found():
    rng = np.random.default_rng(2)
    for _ in range(20):
        anchors = rng.uniform((0, 0, 0), (20, 20, 3), (4, 3))
        tag = np.append(rng.uniform(-5, 25, 2), 1.0)
        found = candidate_positions(
            anchors, np.linalg.norm(anchors - tag, axis=1), np.full(4, 0.1), NoiseModel(), height=Height(1.0)
        )
        assert min(np.linalg.norm(place.position - tag) for place in found) < 0.05
    line = np.array([[0.0, 0, 1], [4, 0, 1], [9, 0, 1]])
    range_m, sd_m = np.linalg.norm(line - (3, 2, 1), axis=1), np.full(3, 0.1)
    found = candidate_positions(line, range_m, sd_m, NoiseModel(), height=Height(1.0))
    assert sorted(round(float(place.position[1])) for place in found) == [-2, 2]


def test_the_best_position_on_a_wall_is_found_if_the_optimum_is_outside():
    anchors = np.array([[0.0, 8, 1], [1, 8, 1], [0, 7, 1], [8, -8, 1]])
    ranges = np.linalg.norm(anchors - (6.0, -0.3, 1.0), axis=1)
    area = Area((1, 0, 0), (9, 9, 2))
    best, *_ = candidate_positions(
        anchors, ranges, np.full(4, 0.1), NoiseModel(), height=Height(1.0), area=area
    )
    along = np.linspace(1, 9, 8001)
    residuals = np.linalg.norm(anchors[:, :2] - np.stack([along, 0 * along], 1)[:, None], axis=2) - ranges
    assert best.position[0] == pytest.approx(along[np.argmin((residuals**2).sum(axis=1))], abs=0.05)
    assert best.position[1] == 0.0


def test_shapes_of_anchors_and_dilution():
    square = np.array([[0.0, 0, 2], [4, 0, 2], [4, 4, 2], [0, 4, 2]])
    assert [extents(one) for one in (square[:1], square[:2], square, HALL.position)] == [0, 1, 2, 3]
    middle = np.array([2.0, 2, 2])
    assert dop(square, middle, level=True).hdop == pytest.approx(1.0)
    assert math.isinf(dop(square[:2], np.array([2.0, 0, 2]), level=True).hdop)


def test_errors_of_known_size():
    covariance = np.broadcast_to(np.diag([0.04, 0.01, 1.0]), (4000, 3, 3))
    error = np.random.default_rng(1).normal(0, 1, (4000, 3)) * (0.2, 0.1, 1.0)
    found = errors_of(error, covariance, np.zeros((4000, 3)))
    assert found.nees_per_dof == pytest.approx(1, abs=0.05)
    assert found.coverage95 == pytest.approx(0.95, abs=0.01)
    assert found.rmse == pytest.approx(math.hypot(0.2, 0.1), rel=0.03)
    assert found.exceeded < 0.006


def test_truth_is_not_interpolated_across_gaps():
    path = TruePath(np.array([0, 1, 5]) * NANOSECONDS, np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]))
    at = path.position_at(np.array([-1, 0, NANOSECONDS // 2, 3 * NANOSECONDS, 6 * NANOSECONDS]))
    np.testing.assert_array_equal(at[:, 0], [np.nan, 0, 0.5, np.nan, np.nan])


def test_model_out_of_range_is_refused():
    with pytest.raises(ParameterError, match="range_sd"):
        NoiseModel(range_sd=math.nan)


def test_ellipse_contains_95_percent_of_the_errors():
    covariance = np.array([[0.5, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 9.0]])
    major, minor, angle = horizontal_ellipse(covariance)
    x, y = np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance, 100_000).T[:2]
    along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    assert np.mean((along / major) ** 2 + (across / minor) ** 2 < 1.0) == pytest.approx(0.95, abs=0.003)
    assert np.isnan(horizontal_ellipse(-covariance)).all()


def test_position_is_withheld_after_the_line_of_two_anchors_was_touched():
    entries = [entry for entry in ambiguous_drives() if entry["name"] == "two anchors, crossing the line"]
    assert max(entry["protection_exceeded"] for entry in entries) <= 0.01
    assert min(entry["availability"] for entry in entries) > 0.2


@pytest.mark.parametrize("kind", ["clean", "nlos", "outliers"])
def test_errors_are_near_those_of_simple_filters(kind: str):
    run = next(run for run in simulated_runs() if (run.set_name, run.name) == ("hall", kind))
    entry = evaluate(run, calibrate=False, complete=False)
    assert entry["ratio_to_best_baseline"] < 1.1
    assert entry["rows"]["raw_locator"]["coverage95"] > 0.89
    assert entry["rows"]["raw_locator"]["rmse_m"] < 0.12


def test_constant_errors_move_a_position_as_least_squares_with_an_offset_does():
    anchors, position = np.array([(0, 0, 1), (9, 0, 1), (9, 7, 1), (0, 7, 1.0)]), np.array([3.0, 4.0, 1.0])
    covariance = constant_error_gain(anchors, position, 2, 100.0)
    away = position - anchors
    rows = np.column_stack([away[:, :2] / np.linalg.norm(away, axis=1)[:, None], np.ones(4)])
    np.testing.assert_allclose(covariance[:2, :2], np.linalg.inv(rows.T @ rows)[:2, :2], rtol=0.01)
    assert not covariance[2].any()


@pytest.mark.parametrize("is_corrected", [[False], [True], [True, False, False, False]])
def test_published_covariance_contains_constant_errors_that_are_not_states(is_corrected: list[bool]):
    one = RangeFilter(HALL, NoiseModel(offset_sd=0.0), 0.0, np.array([6.0, 4.0, 1.0]), np.eye(3) * 0.01)
    for row, corrected in enumerate(is_corrected):
        one.update(row, math.dist(HALL.position[row], one.position), 0.01, corrected)
    AmbiguityCheck(EstimatorConfig(HALL, NoiseModel(offset_sd=0.0))).check(one, [0, 1, 2, 3], 2)
    gain = constant_error_gain(HALL.position[:4], one.position, 2, 0.0)
    np.testing.assert_allclose(
        one.unseen[:3, :3], (1.0 - np.mean(is_corrected)) * CONSTANT_SD**2 * gain, atol=1e-6
    )


@pytest.mark.parametrize(
    ("tilt", "sd_m", "expected"),
    [(0.1, 0.05, Ambiguity.HEIGHT), (0.25, 0.05, Ambiguity.MIRROR), (0.25, 0.3, Ambiguity.HEIGHT)],
)
def test_image_in_a_tilted_plane_is_another_height_if_its_x_is_within_the_errors(
    tilt: float, sd_m: float, expected: Ambiguity
):
    places = [(x * math.cos(tilt), y, x * math.sin(tilt)) for x in (-4.0, 4.0) for y in (-3.0, 3.0)]
    plane = anchors_at(places, SD_M)
    # The image is below the plane, at x = sin(tilt).
    position = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
    one = RangeFilter(plane, NoiseModel(), 0.0, position, np.diag([sd_m, 0.05, 0.05]) ** 2)
    check = AmbiguityCheck(EstimatorConfig(plane))
    check.check(one, [0, 1, 2, 3], 3)
    assert check.ambiguity is expected
    # Both explain the ranges: their mean is published.
    mean_x = math.sin(tilt) if expected is Ambiguity.HEIGHT else 0.0
    np.testing.assert_allclose(check.shift, (mean_x, 0.0, 0.0), atol=0.01)


def test_joined_ranges_are_corrected_as_before():
    raw = drive(seconds=1)[0].take(slice(3))
    groups = [replace(raw, is_corrected=False), replace(raw, is_corrected=np.array([True, False, True]))]
    assert Ranges.of_tags(groups).is_corrected.tolist() == [False, False, False, True, False, True]


def named_anchor(route: list[tuple[float, float]], errors_m: dict[int, Callable[..., float]]) -> int | None:
    """Return the anchor of a hall that is named after a drive at 2 m/s with ranges at 20 Hz; errors depend on x, y, z of the tag."""
    tests, time_s = {anchor: ResidualDirections() for anchor in range(4)}, 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(route):
        for share in np.linspace(0.0, 1.0, round(10 * math.hypot(x1 - x0, y1 - y0))).tolist():
            tag, time_s = (x0 + share * (x1 - x0), y0 + share * (y1 - y0), 0.0), time_s + 0.05
            for anchor, test in tests.items():
                place = (10.0 * (anchor % 2), 8.0 * (anchor // 2), 2.0)
                error_m = errors_m[anchor](*tag) if anchor in errors_m else 0.0
                test.add(time_s, math.dist(tag, place) + error_m, tag, place)
    return (displaced_anchor(tests) or (None,))[0]


def test_displaced_anchor_is_named_but_none_behind_an_obstacle():
    lap = [(1.0, 1.0), (9.0, 1.0), (9.0, 7.0), (1.0, 7.0), (1.0, 1.0)]
    displaced = {
        1: lambda *tag: math.dist(tag, (10.0, 1.2, 2.0)) - math.dist(tag, (10.0, 0.0, 2.0)),
        2: lambda *tag: math.dist(tag, (0.0, 7.0, 2.0)) - math.dist(tag, (0.0, 8.0, 2.0)),
    }
    assert named_anchor(lap, {1: displaced[1]}) == 1
    assert named_anchor(lap, displaced) is None, "none stands out"
    inner = [(2.5, 2.5), (7.5, 2.5), (7.5, 5.5), (2.5, 5.5), (2.5, 2.5)]
    assert named_anchor([*lap, *inner], {1: lambda *tag: 0.35 * displaced[1](*tag)}) is None, "too little"
    assert named_anchor(lap, {1: lambda *tag: 0.37 * displaced[1](*tag)}) is None, "improbable"
    assert named_anchor(lap[1:3], {1: lambda *tag: 2.0 * displaced[1](*tag)}) is None, "few places"
    assert named_anchor(lap, {1: lambda *tag: 0.8}) is None, "an offset"
    assert named_anchor(lap, {1: lambda x, y, z: 1.5 * (4.0 < x < 6.0)}) is None, "an obstacle"
    # Errors of one aisle are not independent, however often it is driven.
    assert named_anchor([(1.0, 1.0), (5.0, 1.0)] * 20, {1: lambda x, y, z: 0.6 * (x > 3.0)}) is None
    # The anchors file may have been corrected two minutes ago.
    assert named_anchor([*lap, *[(1.0, 1.0), (1.4, 1.0)] * 330], {1: displaced[1]}) is None
