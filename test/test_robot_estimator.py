"""Position and heading of a robot with odometry."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drives import HALL, NANOSECONDS, Robot, drive, wrapped

from benchmarks.position_data import GEOMETRIES, load_geometry, real_runs
from benchmarks.positions import evaluate, locate, odometry_faults
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.config import RobotData
from uwb_mitigation.positioning.geometry import Area
from uwb_mitigation.positioning.multi_tag import MultiTagEstimator
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.dead_reckoning import ODOMETRY_TIMEOUT_S, DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.filter import FIRST_ERROR, RangeFilter
from uwb_mitigation.positioning.online.heading_test import KNOWN_YAW_SD, HeadingTest
from uwb_mitigation.positioning.online.odometry_filter import OdometryFilter
from uwb_mitigation.positioning.online.robot_estimator import RobotEstimator
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.tracks import Imu, Odometry


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("facing", [0.0, 1.1, 2.2, 3.3, 4.4, 5.5])
def test_heading_is_found_from_any_start(facing: float):
    robot = Robot(facing=facing)
    estimator = RobotEstimator(robot.config)
    track = estimator.run(robot.ranges())
    found_s = track.stamp_ns[np.isfinite(track.yaw[:, 0])][0] / NANOSECONDS
    distance, of_yaw, sd = robot.errors(track, 12.0)
    assert 9.0 < found_s < 15.0, "one that is confirmed earlier may be that of late odometry"
    assert len(of_yaw) == len(distance), "the heading is not lost again"
    assert rms(of_yaw) < math.radians(3.0)
    assert np.mean(np.abs(of_yaw) < 1.96 * sd) > 0.9
    assert estimator.tag.counts["odometry wrong"] == 0


def test_odometry_reduces_the_position_error():
    robot = Robot()
    rmse_m = []
    for ranges in (robot.ranges(seed=seed) for seed in range(4)):
        tracks = RobotEstimator(robot.config).run(ranges), TagEstimator(robot.config).run(ranges)
        rmse_m.append([rms(robot.errors(track, 5.0)[0]) for track in tracks])
    with_odometry, without = np.mean(rmse_m, axis=0)
    assert with_odometry < 0.8 * without


def test_lever_arm_is_rotated_by_the_heading():
    robot = Robot(lever=(0.5, 0.2, 0.3))
    distance, of_yaw, _ = robot.errors(RobotEstimator(robot.config).run(robot.ranges()), 12.0)
    wrong = replace(robot.config, robot=RobotData(robot.odometry, lever_arm=(-0.5, -0.2, 0.3)))
    assert rms(of_yaw) < math.radians(3.0)
    assert rms(distance) < 0.2
    assert rms(robot.errors(RobotEstimator(wrong).run(robot.ranges()), 12.0)[1]) > 2.0 * rms(of_yaw)


def test_heading_of_a_stationary_robot_is_unknown():
    robot = Robot(stand=(0.0, 30.0))
    standing = RobotEstimator(robot.config)
    standing.run(robot.ranges(seconds=25.0))
    assert standing.heading == "unknown"
    track = RobotEstimator(robot.config).run(robot.ranges())
    known = np.isfinite(track.yaw[:, 0])
    assert not known[track.stamp_ns < 30 * NANOSECONDS].any()
    assert known[track.stamp_ns > 45 * NANOSECONDS].all()


def test_slipping_wheels_are_detected():
    robot = Robot(slip=(20.0, 26.0), seconds=180.0)
    estimator = RobotEstimator(robot.config)
    track = estimator.run(ranges := robot.ranges(180.0))
    assert estimator.tag.counts["odometry wrong"] >= 1
    late_m = rms(robot.errors(track, 150.0)[0])
    assert late_m < 0.8 * rms(robot.errors(TagEstimator(robot.config).run(ranges), 150.0)[0]), "forgiven"
    distance, of_yaw, _ = robot.errors(track, 40.0)
    assert len(of_yaw) == len(distance)
    assert rms(of_yaw) < math.radians(4.0)
    slipping = (track.stamp_ns > 20 * NANOSECONDS) & (track.stamp_ns < 27 * NANOSECONDS)
    # The wheels measure 6 m too much.
    assert robot.errors(track.take(slipping))[0].max() < 1.5


def test_missing_odometry_leaves_ranges_only():
    robot = Robot()
    time_s = robot.odometry.stamp_ns / NANOSECONDS
    odometry = robot.odometry.take((time_s < 20) | (time_s > 30))
    estimator = RobotEstimator(replace(robot.config, robot=RobotData(odometry)))
    ranges = robot.ranges()
    track = estimator.run(ranges)
    known = np.isfinite(track.yaw[:, 0])
    missing = (track.stamp_ns > 21 * NANOSECONDS) & (track.stamp_ns < 30 * NANOSECONDS)
    assert not known[missing].any()
    assert known[(track.stamp_ns > 15 * NANOSECONDS) & (track.stamp_ns < 20 * NANOSECONDS)].all()
    assert known[track.stamp_ns > 42 * NANOSECONDS].all()
    assert estimator.tag.counts["odometry missing"] == 1
    alone = TagEstimator(replace(robot.config, robot=None)).run(ranges)
    np.testing.assert_allclose(
        track.position[missing], alone.position[np.isin(alone.stamp_ns, track.stamp_ns[missing])]
    )


def test_drift_is_estimated_again_when_the_imu_is_lost():
    robot = Robot()
    wheels = robot.odometry
    # The wheels drift by 0.05 rad/m, the IMU does not; it is lost after 30 s.
    twist = wheels.twist + 0.04 * np.hypot(*wheels.twist[:, :2].T)[:, None] * (0.0, 0.0, 1.0)
    wheels = replace(wheels, pose=np.full_like(wheels.pose, np.nan), twist=twist)
    time_s = wheels.stamp_ns[wheels.stamp_ns < 30 * NANOSECONDS] / NANOSECONDS
    n = len(time_s)
    rate = np.gradient(robot.yaw(time_s), time_s)
    imu = Imu(wheels.stamp_ns[:n], rate, np.full(n, 1e-6), np.full(n, np.nan), np.zeros(n))
    track = RobotEstimator(replace(robot.config, robot=RobotData(wheels, imu))).run(robot.ranges())
    _, with_imu, sd = robot.errors(track.take(track.stamp_ns < 30 * NANOSECONDS), 15.0)
    assert rms(with_imu / sd) < 1.5
    _, without, sd = robot.errors(track, 30.0)
    assert len(without) > 1000
    assert rms(without / sd) < 1.5


def test_kidnapped_robot_is_found_again():
    robot = Robot()
    ranges = robot.ranges()
    moved = ranges.stamp_ns > 30 * NANOSECONDS
    # It is now on the other side of the hall, and faces another direction; its wheels did not turn.
    other = drive(seconds=60.0, path=lambda time_s: (12.0, 9.0, 0.0) + robot.antenna(time_s) * (-1, -1, 1))[0]
    ranges = replace(ranges, range_m=np.where(moved, other.range_m, ranges.range_m))
    estimator = RobotEstimator(robot.config)
    track = estimator.run(ranges)
    late = track.take(track.stamp_ns > 45 * NANOSECONDS)
    time_s = late.stamp_ns / NANOSECONDS
    true = (12.0, 9.0, 0.0) + robot.antenna(time_s) * (-1, -1, 1)
    assert estimator.tag.counts["odometry wrong"] >= 1
    assert rms(np.linalg.norm((late.position - true)[:, :2], axis=1)) < 0.2
    assert rms(wrapped(late.yaw[:, 0] - robot.yaw(time_s) - math.pi)) < math.radians(5.0)


def test_robot_position_is_predicted_with_odometry_without_ranges():
    robot = Robot()
    ranges = robot.ranges()
    kept = ranges.take((ranges.stamp_ns < 20 * NANOSECONDS) | (ranges.stamp_ns > 28 * NANOSECONDS))
    track = RobotEstimator(robot.config).run(kept)
    first = track.take(track.stamp_ns > 28 * NANOSECONDS).take(slice(0, 5))
    assert np.isfinite(first.yaw[:, 0]).all()
    assert robot.errors(first)[0].max() < 0.6


def test_estimates_stay_inside_the_area():
    robot = Robot(lever=(0.5, 0.0, 0.0))
    area = Area((2.0, 1.5, 0.0), (10.0, 7.5, 2.0))
    track = RobotEstimator(replace(robot.config, area=area)).run(robot.ranges())
    assert np.isfinite(track.yaw[:, 0]).any()
    assert area.holds(track.position).all()


def test_antenna_is_projected_onto_the_area():
    one, area = _filter(), Area((0.0, 0.0, 0.0), (4.5, 3.5, 1.0))
    assert math.dist(one.antenna, (4.5, 3.5, 1.0)) > 0.4
    one.confine(area)
    # The projection also turns the robot a little, and its lever arm.
    assert one.antenna == pytest.approx((4.5, 3.5, 1.0), abs=0.05)
    assert np.max(np.subtract(one.antenna, area.high)) < 1e-9


HUGE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e38, 1e9, 1e5, 0.0, -1.0, 1e-300)


@pytest.mark.parametrize("seed", range(6))
def test_hostile_input_leaves_finite_estimates(seed: int):
    robot, rng = Robot(seconds=12.0), np.random.default_rng(seed)
    height = robot.config.height if seed % 2 else None
    config = replace(robot.config, height=height, robot=RobotData(lever_arm=(0.3, 0.1, 0.2)))
    estimator, ranges, measured = MultiTagEstimator(config), robot.ranges(seconds=12.0), robot.odometry

    def spoiled(*values: float) -> list[float]:
        return [float(rng.choice(HUGE)) if rng.random() < 0.05 else value for value in values]

    def late(stamp_ns: int) -> int:
        return stamp_ns + (int(rng.choice([0, -1, 5, -(10**9)])) * NANOSECONDS if rng.random() < 0.02 else 0)

    rows = iter(range(len(measured)))
    estimates = 0
    for i, stamp in enumerate(ranges.stamp_ns.tolist()):
        while (row := next(rows, None)) is not None and measured.stamp_ns[row] <= stamp:
            at, rate = late(int(measured.stamp_ns[row])), float(measured.twist[row, 2])
            estimator.odometry.add_imu(at, *spoiled(rate, 1e-4))
            pose, twist = measured.pose[row].tolist(), measured.twist[row].tolist()
            estimator.odometry.add(at, spoiled(*pose), spoiled(*twist), spoiled(4e-4, 4e-4, 4e-4))
        if i % 10 == 0 and 7 in estimator.tags:
            estimator.tags[7].add_height(*spoiled(1.2, 0.01))
        anchor = HALL.anchors[ranges.anchor[i]].id
        found = estimator.add(7, anchor, late(stamp), *spoiled(float(ranges.range_m[i]), 0.01))
        if found is None:
            continue
        tag, estimate = found
        # The second one is predicted over a time that no program should ask for.
        for one in (
            estimate,
            tag.best.predict_at(stamp + 10**18),
            tag.smoother.estimate() if i % 20 == 0 else None,
        ):
            if one is not None:
                estimates += 1
                assert np.isfinite(one.position).all()
                assert np.isfinite(one.covariance).all()
                assert np.linalg.eigvalsh(one.covariance[:2, :2]).min() > 0.0
    assert estimates > 50
    assert estimator.invalid > 10


def test_prediction_after_the_last_range_uses_the_motion():
    robot = Robot()
    estimator = RobotEstimator(robot.config)
    ranges = robot.ranges(seconds=20.0)
    *_, estimate = estimator.run(ranges)
    ahead = estimator.predict_at(int(ranges.stamp_ns[-1]) + 300_000_000)
    assert ahead.heading is not None
    true = robot.antenna(np.array([ahead.stamp_ns / NANOSECONDS]))[0]
    assert np.linalg.norm((ahead.position - true)[:2]) < np.linalg.norm((estimate.position - true)[:2])
    # Without odometry for longer, only the ranges-only estimate is left.
    late = estimator.predict_at(int(ranges.stamp_ns[-1]) + 2 * NANOSECONDS)
    assert late.heading is None


def _filter() -> OdometryFilter:
    rng = np.random.default_rng(3)
    start = RangeFilter(HALL, NoiseModel(), 0.0, np.array([5.0, 4.0, 1.0]), np.diag([0.04, 0.09, 0.01]))
    start.update(1, 5.0, 0.01, True)
    start.P[FIRST_ERROR:, FIRST_ERROR:] += 0.001
    one = OdometryFilter(HALL, NoiseModel(), start, PathPoint(1, 0.3, 0.2, 0.5), (0.4, -0.3, 0.2), (0.7, 0.2))
    one.state.x[:] += 0.01 * rng.normal(size=len(one.state.x))
    return one


def test_derivatives_of_the_filter_are_those_of_its_equations():
    point = PathPoint(1, 0.8, 0.1, 0.9, 0.6, 0.012, 0.03)

    def after(x):
        one = _filter()
        one.state.x[:] = x
        one.advance(1e-9, point)
        return one.state.x.copy()

    one = _filter()
    x = one.state.x.copy()
    n, step = len(x), 1e-6
    F = np.column_stack([(after(x + step * e) - after(x - step * e)) / (2 * step) for e in np.eye(n)])
    before = one.state.P.copy()
    one.advance(1e-9, point)
    noise = one.state.P - F @ before @ F.T
    # Only the height is uncertain: the floor may be a slope.
    np.testing.assert_allclose(noise[[0, 1, 3, 4, 5, 6, 7], :8], 0.0, atol=1e-8)

    def residual(x):
        other = _filter()
        other.state.x[:] = x
        z, sd = other.update(1, 5.0, 0.01, True)
        return -z * sd

    one.state.normalise()
    x = one.state.x.copy()
    one.update(1, 5.0, 0.01, True)
    H = np.array([(residual(x + step * e) - residual(x - step * e)) / (2 * step) for e in np.eye(n)])
    np.testing.assert_allclose(one.state.H, H, atol=1e-5)


def test_filter_starts_with_the_antenna_of_the_range_filter():
    start = RangeFilter(HALL, NoiseModel(), 0.0, np.array([5.0, 4.0, 1.0]), np.diag([0.04, 0.09, 0.01]))
    one = OdometryFilter(HALL, NoiseModel(), start, PathPoint(1), (0.4, -0.3, 0.2), (0.7, 0.2))
    np.testing.assert_allclose(one.antenna, start.position)
    _, _, _, xx, xy, yy, *_ = one.published()
    np.testing.assert_allclose((xx, xy, yy), start.estimate(0).covariance[[0, 0, 1], [0, 1, 1]], atol=1e-12)


def _add_all(path: DeadReckoning, odometry: Odometry, *, poses: bool) -> None:
    for stamp, pose, twist in zip(odometry.stamp_ns.tolist(), odometry.pose.tolist(), odometry.twist.tolist(), strict=True):  # fmt: skip
        path.add(stamp, pose if poses else None, twist)


@pytest.mark.parametrize("poses", [True, False])
def test_path_follows_poses_or_twists(poses: bool):
    odometry = Robot(seconds=5.0).odometry
    path = DeadReckoning()
    # Twists that are a little wrong have no effect next to poses.
    _add_all(path, replace(odometry, twist=odometry.twist * (1.2 if poses else 1.0)), poses=poses)
    for row in (60, 200, 249):
        point = path.point_at(int(odometry.stamp_ns[row]))
        np.testing.assert_allclose((point.x, point.y, point.yaw), odometry.pose[row], atol=0.01)
    between = path.point_at(int(odometry.stamp_ns[100]) + 10_000_000)
    np.testing.assert_allclose((between.x, between.y), odometry.pose[100:102, :2].mean(axis=0), atol=0.005)
    end_ns = int(odometry.stamp_ns[-1])
    assert path.point_at(end_ns + round(0.9 * ODOMETRY_TIMEOUT_S * NANOSECONDS)) is not None
    assert path.point_at(end_ns + round(1.1 * ODOMETRY_TIMEOUT_S * NANOSECONDS)) is None
    assert path.twist is not None
    path.add(end_ns + NANOSECONDS, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    assert path.twist is None, "it is unknown after a gap"


def test_path_survives_a_reset_of_the_odometry_frame():
    odometry = Robot(seconds=5.0).odometry
    pose = odometry.pose.copy()
    pose[150:] += (7.0, -3.0, 0.0)
    path = DeadReckoning()
    _add_all(path, replace(odometry, pose=pose), poses=True)
    point = path.point_at(int(odometry.stamp_ns[-1]))
    assert math.hypot(*(np.array([point.x, point.y]) - odometry.pose[-1, :2])) < 0.05


def test_yaw_rates_of_the_imu_replace_those_of_the_wheels_except_one_with_a_wrong_stamp():
    path = DeadReckoning()
    for stamp in range(0, 2 * NANOSECONDS, 10_000_000):
        is_wrong = stamp == 1_010_000_000
        path.add_imu(stamp + is_wrong * 86_400 * NANOSECONDS, 1e-9 * stamp, 1e-4)
        if stamp % 20_000_000 == 0:
            path.add(stamp, (0.5e-9 * stamp, 0.0, 0.0), (0.5, 0.0, 0.0))
    assert path.point_at(2 * NANOSECONDS).yaw == pytest.approx(2.0, abs=0.1)


def test_orientation_of_the_imu_counts_by_its_differences():
    path = DeadReckoning()
    for stamp in range(0, 5 * NANOSECONDS + 1, 20_000_000):
        # Where the orientation is unknown, the yaw rate counts.
        is_known = not 2.0 < stamp / NANOSECONDS < 2.5
        yaw = float(wrapped(3.0 + 0.3 * stamp / NANOSECONDS)) if is_known else math.nan
        path.add_imu(stamp, 0.0 if is_known else 0.3, 1e-4, yaw)
        path.add(stamp, None, (0.5, 0.0, 0.0))
    assert path.point_at(stamp).yaw == pytest.approx(0.3 * 5.0, abs=0.02)


@pytest.mark.parametrize(
    "twist", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (1e9, 0.0, 0.0), (0.0, 0.0, 99.0)]
)
def test_invalid_odometry_is_rejected(twist):
    path = DeadReckoning()
    path.add(0, None, (0.1, 0.0, 0.0))
    path.add(20_000_000, None, twist)
    path.add(20_000_000, (math.nan, 0.0, 0.0), (0.1, 0.0, 0.0), (math.nan, -1.0, math.inf))
    path.add(10_000_000, None, (0.1, 0.0, 0.0))
    path.add_imu(0, twist[2] + twist[0] + twist[1])
    assert path.rejected == 3
    assert path.point_at(20_000_000).x == pytest.approx(0.002)


@pytest.mark.parametrize("poses", [True, False])
def test_motion_backwards_in_time_returns_to_the_start(poses: bool):
    odometry = Robot(seconds=5.0).odometry
    path = DeadReckoning()
    _add_all(path, odometry.reversed(int(odometry.stamp_ns[-1])), poses=poses)
    point = path.point_at(5 * NANOSECONDS)
    x, y, yaw = odometry.pose[0] - odometry.pose[-1]
    cosine, sine = math.cos(odometry.pose[-1, 2]), math.sin(odometry.pose[-1, 2])
    assert point.yaw == pytest.approx(yaw, abs=0.01)
    assert (point.x, point.y) == pytest.approx((cosine * x + sine * y, cosine * y - sine * x), abs=0.05)


def test_smoothed_track_has_headings_from_the_start():
    robot = Robot()
    ranges = robot.ranges()
    live = RobotEstimator(robot.config).run(ranges)
    smoothed = smooth(robot.config, ranges, live)
    early = smoothed.take(smoothed.stamp_ns < int(live.stamp_ns[np.isfinite(live.yaw[:, 0])][0]))
    assert len(early) > 5
    assert np.isfinite(early.yaw[:, 0]).all()
    distance, of_yaw, _ = robot.errors(smoothed)
    assert rms(of_yaw) < math.radians(3.0)
    assert rms(distance) < rms(robot.errors(live)[0])


@pytest.mark.parametrize(
    ("layout", "seed", "seconds", "late_s"),
    [
        # A sharp turn that neither the odometry nor the ranges show yet.
        ("ceiling_hall", 11, 120.0, 1.0),
        ("ceiling_hall", 24, 60.0, 1.0),
        # Not late enough to be excluded as such.
        ("level_square_small", 23, 120.0, 0.3),
        # Range errors that are larger than modelled, and those that turn the path.
        ("corridor", 23, 120.0, 0.0),
        ("corridor", 30, 120.0, 0.0),
    ],
)
def test_heading_contains_errors(data: Path, layout: str, seed: int, seconds: float, late_s: float):
    run = load_geometry("", "", str(data / "geometries" / GEOMETRIES), layout, 2, seed, seconds)
    late = replace(run.robot.odometry, stamp_ns=run.robot.odometry.stamp_ns + round(late_s * NANOSECONDS))
    track = locate(run, run.ranges, replace(run.robot, odometry=late))
    assert not track_errors(track, run.truth).heading_exceeded > 0.01
    known = track.take(np.isfinite(track.yaw[:, 4]))
    assert np.all(known.yaw[:, 4] < math.radians(45.1) ** 2)
    # The heading rotates the velocity of the odometry.
    assert np.all(known.covariance[:, 3, 3] > known.yaw[:, 4] * np.sum(known.velocity[:, :2] ** 2, axis=1))


def test_real_robot_reaches_the_documented_errors(data: Path):
    runs, _ = real_runs(data)
    run = next(run for run in runs if run.set_name == "labyrinth")
    row = evaluate(run, calibrate=False, complete=False)["rows"]["odometry_locator"]
    assert row["rmse_m"] <= 0.07
    assert row["coverage95"] >= 0.89
    assert row["heading_rmse_deg"] <= 14.0


@pytest.mark.parametrize("fault", ["sign of yaw rate", "scale 0.5"])
def test_wrong_odometry_is_not_worse_than_ranges_only(fault: str):
    robot = Robot(seconds=90.0)
    ranges = robot.ranges(seconds=90.0)
    alone = robot.errors(TagEstimator(replace(robot.config, robot=None)).run(ranges), 5.0)[0]
    wrong = replace(robot.config, robot=RobotData(odometry_faults(robot.odometry)[fault]))
    assert rms(robot.errors(RobotEstimator(wrong).run(ranges), 5.0)[0]) <= 1.02 * rms(alone)


@pytest.mark.parametrize("fault", ["world axes", "sign of yaw rate"])
def test_wrong_headings_are_not_published(fault: str):
    robot = Robot()
    wrong = replace(robot.config, robot=RobotData(odometry_faults(robot.odometry)[fault]))
    _, of_yaw, sd = robot.errors(RobotEstimator(wrong).run(robot.ranges()))
    assert np.sum(np.abs(of_yaw) > 3.29 * sd) <= 0.01 * len(of_yaw)


def test_heading_on_a_circle_contains_the_turn_that_late_odometry_would_hide():
    heading_test, point = HeadingTest((0.0, 0.0, 0.0)), PathPoint(1)
    for time_s in np.arange(0.0, 60.0, 0.1).tolist():
        yaw = 0.1 * time_s
        point = PathPoint(1, 5.0 * math.sin(yaw), 5.0 - 5.0 * math.cos(yaw), yaw, 0.5 * time_s)
        if heading_test.is_due(time_s, point):
            heading_test.add(time_s, complex(point.x, point.y), 0.01, point)
    sd = math.sqrt(heading_test.variance(point.yaw, 1e-4, point))
    assert math.radians(16.0) < 3.29 * sd < 3.29 * KNOWN_YAW_SD


@pytest.mark.parametrize("is_white", [False, True])
def test_heading_survives_two_minutes_at_rest(is_white: bool):
    robot = Robot(stand=(20.0, 140.0), seconds=160.0)
    ranges = robot.ranges(seconds=160.0)
    if is_white:
        antenna = robot.antenna(ranges.stamp_ns / NANOSECONDS)
        error = np.random.default_rng(1).normal(0.1, 0.1, len(ranges))
        ranges.range_m[:] = np.linalg.norm(antenna - HALL.position[ranges.anchor], axis=1) + error
    estimator = RobotEstimator(robot.config)
    track = estimator.run(ranges)
    assert estimator.tag.counts["odometry wrong"] == 0
    _, of_yaw, sd = robot.errors(track, 15.0)
    assert len(of_yaw) == (track.stamp_ns >= 15 * NANOSECONDS).sum()
    assert rms(of_yaw) < math.radians(5.0)
    assert np.mean(np.abs(of_yaw) < 1.96 * sd) > 0.9


def test_scale_error_of_rotations_is_a_part_of_the_uncertainty_of_the_yaw():
    start = RangeFilter(HALL, NoiseModel(), 0.0, np.array([5.0, 4.0, 1.0]), np.diag([0.01, 0.01, 0.01]))
    path = DeadReckoning()
    path.add(0, None, (0.0, 0.0, 1.0))
    one = OdometryFilter(HALL, NoiseModel(), start, path.point_at(0), (0.0, 0.0, 0.0), (0.0, 0.05))
    for stamp in range(20_000_000, 60 * NANOSECONDS, 20_000_000):
        path.add(stamp, None, (0.0, 0.0, 1.05))
        one.advance(stamp / NANOSECONDS, path.point_at(stamp))
    assert abs(one.yaw - 60.0) < 2.0 * math.sqrt(one.yaw_variance)
