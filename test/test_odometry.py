"""Odometry, IMU data and tf of a simulated drive: their errors, and bags that other tools read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import succeed
from rosbags.highlevel import AnyReader

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag import odometry as codec
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.simulation import odometry as simulation
from uwb_mitigation.simulation.odometry import simulate_motion, yaw_along_route
from uwb_mitigation.simulation.scene import ROUTE
from uwb_mitigation.simulation.simulated import SPEED_M_PER_S, SimulatedSource
from uwb_mitigation.types.ros.topics import IMU_TYPE, ODOMETRY_TYPE
from uwb_mitigation.types.tracks import Imu, Odometry

SECONDS = 300.0


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("drive") / "drive.mcap"
    succeed("data", "simulate", "-o", bag, "--ranges", "400", folder=bag.parent)
    return bag


def test_heading_follows_the_route_over_all_laps():
    at = np.linspace(0.0, 200.0, 20_001)
    yaw = yaw_along_route(ROUTE, at)
    # A turn by less than 180 degrees takes half a metre.
    assert np.abs(np.diff(yaw)).max() <= np.pi / 0.5 * 0.0101
    assert yaw_along_route(ROUTE, np.array([0.6])) == pytest.approx(np.arctan2(0.1, 1.2))
    closed = np.array([*ROUTE, ROUTE[0]])
    lap = np.hypot(*np.diff(closed, axis=0).T).sum()
    turned = yaw_along_route(ROUTE, np.array([5.0, 5.0 + 3 * lap]))
    assert (turned[1] - turned[0]) / (2 * np.pi) % 1 == pytest.approx(0.0, abs=1e-9)


def test_without_errors_the_odometry_is_the_true_path(monkeypatch: pytest.MonkeyPatch):
    for name in ("SCALE_ERROR", "DRIFT_RAD_PER_M", "SPEED_SD", "TURN_SD", "SLIP_SHARE", "SLIP_TURN_SD"):
        monkeypatch.setattr(simulation, name, 0.0)
    motion = simulate_motion(ROUTE, SPEED_M_PER_S, SECONDS, seed=1)
    start = motion.yaw[0]
    cosine, sine = np.cos(start), np.sin(start)
    position = motion.position[0] + motion.odometry.pose[:, :2] @ [[cosine, sine], [-sine, cosine]]
    np.testing.assert_allclose(position, motion.position, atol=1e-3)
    np.testing.assert_allclose(motion.odometry.pose[:, 2], motion.yaw - start, atol=1e-9)


def test_odometry_has_a_scale_error_of_two_percent_drift_and_slip():
    ratios, slips, drifts, biases = [], [], [], []
    for motion in [simulate_motion(ROUTE, SPEED_M_PER_S, SECONDS, seed) for seed in range(8)]:
        true = np.diff(motion.position, axis=0) * simulation.RATE_HZ
        fast = np.hypot(*true.T) > 0.45
        ratio = np.hypot(*motion.odometry.twist[1:, :2].T)[fast] / np.hypot(*true.T)[fast]
        ratios.append(abs(np.median(ratio) - 1.0))
        slips.append(np.mean(ratio > 1.25))
        drifts.append(motion.odometry.pose[-1, 2] - (motion.yaw[-1] - motion.yaw[0]))
        biases.append(np.mean(motion.imu.yaw_rate[1:] - np.diff(motion.yaw) * simulation.RATE_HZ))
    assert ratios == pytest.approx([0.02] * 8, abs=0.003)
    assert np.mean(slips) == pytest.approx(simulation.SLIP_S / simulation.SLIP_EVERY_S, rel=0.5)
    assert np.degrees(np.std(drifts)) > 20
    assert 0.1 < np.degrees(np.std(biases)) < 0.6


def test_simulated_drive_contains_odometry_imu_tf_and_the_true_heading(drive: Path):
    odometry, imu = codec.read_odometry(drive, "/odom"), codec.read_imu(drive, "/imu")
    motion = SimulatedSource(seed=1, count=400).motion()
    n = len(odometry)
    # 400 ranges at 20 Hz; it ends with the last range that is received.
    assert 950 < n <= len(motion.odometry)
    np.testing.assert_allclose(odometry.twist, motion.odometry.twist[:n])
    np.testing.assert_allclose(odometry.twist_covariance, motion.odometry.twist_covariance[:n])
    np.testing.assert_allclose(np.exp(1j * odometry.pose[:, 2]), np.exp(1j * motion.odometry.pose[:n, 2]))
    np.testing.assert_array_equal(imu.stamp_ns, odometry.stamp_ns)
    np.testing.assert_allclose(imu.yaw_rate, motion.imu.yaw_rate[:n])
    assert np.isnan(imu.yaw).all()
    records = list(McapRecording(drive))
    stamps = (np.array([one.measurement.stamp_ns for one in records]) - odometry.stamp_ns[0]) / 1e9
    true = np.array([one.tag_yaw for one in records])
    expected = yaw_along_route(ROUTE, SPEED_M_PER_S * stamps)
    np.testing.assert_allclose(np.exp(1j * true), np.exp(1j * expected), atol=1e-9)
    with AnyReader([drive]) as reader:
        times = [time for _, time, _ in reader.messages()]
        (tf,) = (one for one in reader.connections if one.topic == "/tf")
        transforms = [reader.deserialize(data, tf.msgtype) for _, _, data in reader.messages([tf])]
    assert times == sorted(times)
    (first,) = transforms[500].transforms
    assert (first.header.frame_id, first.child_frame_id) == ("odom", "base_link")
    at = first.transform.translation
    assert (at.x, at.y) == tuple(odometry.pose[500, :2])


def test_messages_with_invalid_values_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    stamps = np.arange(3, dtype=np.int64)
    pose, twist = np.zeros((3, 3)), np.ones((3, 3))
    pose[1, 0] = np.nan
    odometry = Odometry(stamps, pose, np.zeros((3, 3, 3)), twist, np.zeros((3, 3, 3)))
    imu = Imu(stamps, np.array([0.5, 0.5, np.inf]), np.ones(3), np.array([0.1, np.nan, 0.1]), np.ones(3))
    bag = tmp_path / "bag.mcap"
    with BagWriter(bag, {"simulated": "true"}) as out:
        for row in range(3):
            out.write_message("/odom", ODOMETRY_TYPE, codec.encode_odometry_row(odometry, row), row)
            out.write_message("/imu", IMU_TYPE, codec.encode_imu_row(imu, row), row)
            with monkeypatch.context() as patch:
                patch.setattr(codec, "UNOBSERVED", -1.0)
                out.write_message("/no_gyro", IMU_TYPE, codec.encode_imu_row(imu, row), row)
            broken = replace(odometry, twist=twist * np.nan)
            out.write_message("/broken", ODOMETRY_TYPE, codec.encode_odometry_row(broken, row), row)
    # The twist is used if the pose is unknown.
    np.testing.assert_array_equal(codec.read_odometry(bag, "/odom").twist, twist)
    found = codec.read_imu(bag, "/imu")
    np.testing.assert_allclose(found.yaw, [0.1, np.nan])
    np.testing.assert_allclose(found.yaw_rate_variance, 1.0)
    with pytest.raises(RecordingError, match="/no_gyro: no valid message"):
        codec.read_imu(bag, "/no_gyro")
    with pytest.raises(RecordingError, match="/broken: no valid message"):
        codec.read_odometry(bag, "/broken")
    with pytest.raises(RecordingError, match=r"no topic /wheels.*/odom \(nav_msgs/msg/Odometry\)"):
        codec.read_odometry(bag, "/wheels")
