"""The driver on a board's serial link: an emulated board on a pseudo-terminal, real nodes over real DDS."""

import errno
import os
import signal
import termios
import time
from pathlib import Path

import numpy as np
import pytest
import serial

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from diagnostic_msgs.msg import DiagnosticStatus
from port_events import PortEvents, wait_until
from ros_harness import Process, Ros, diagnostic_values, stamped_after
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from benchmarks.equipment.emulated_board import EmulatedBoard
from benchmarks.equipment.faults import Faults
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.radios import serial as serial_source
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.serial import BoardPort, SerialSettings
from uwb_mitigation.radios.settings import RadioSettings, Role
from uwb_mitigation.radios.wire.framing import FrameEncoder
from uwb_mitigation.radios.wire.messages import Hello, RadioConfigured
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import CorrectedBy, RangeMeasurement
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.stamps import to_ns

pytestmark = pytest.mark.ros

LOST = "board: measurements_lost"
RAW = "/uwb/range_raw"
CORRECTED = "/uwb/range_corrected"
FLOOD_BYTES = 4096


class FaultyBoard(EmulatedBoard):
    """An emulated board whose firmware sends noise; `boot_noise`: bytes of it before each HELLO."""

    def __init__(self, *arguments, boot_noise: int = 0, **options) -> None:
        self._boot_noise, self._flood_until = boot_noise, 0.0
        super().__init__(*arguments, **options)

    def flood(self, seconds: float) -> None:
        """Send noise as fast as the port accepts it."""
        with self._lock:
            self._flood_until, self.noise_bytes = time.monotonic() + seconds, 0

    def reset(self) -> None:
        # The thread of the board must not write the backlog while it grows.
        with self._lock:
            super().reset()
            self._backlog[:0] = self._random.bytes(self._boot_noise)

    def _exchange(self, timeout_s: float) -> None:
        with self._lock:
            if time.monotonic() < self._flood_until and len(self._backlog) < FLOOD_BYTES:
                self._backlog += self._random.bytes(FLOOD_BYTES)
                self.noise_bytes += FLOOD_BYTES
        super()._exchange(timeout_s)


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "port"


def board(link: Path, *, model: bool = False, rate_hz: float = 50.0, **options) -> EmulatedBoard:
    if model:
        mitigation = Mitigation(load_bundle(default_model_path()))
        identity = Hello(
            0xB0A2D, mitigation.bundle.model_id, window=mitigation.bundle.card.preprocessing.samples
        )
        options |= {"corrector": mitigation, "identity": identity}
    return FaultyBoard(SimulatedSource(seed=4, count=200), rate_hz=rate_hz, link=link, **options)


def played() -> dict[int, RangeMeasurement]:
    """Return the ranges that a board plays in a loop, by sequence."""
    return {r.measurement.sequence: r.measurement for r in SimulatedSource(seed=4, count=200)}


def drive(ros: Ros, link: Path, *parameters: str) -> Process:
    return ros.start("driver", "source:=serial", f"port:={link}", *parameters)


def diagnostic_value(status: DiagnosticStatus, key: str) -> str:
    return diagnostic_values(status).get(key, "")


def fewest(status: DiagnosticStatus, *keys: str) -> int:
    return min(int(diagnostic_value(status, key) or 0) for key in keys)


def test_measurements_of_a_board_are_published_with_their_stamps(ros: Ros, link: Path):
    received: list[tuple[int, RangeCir]] = []
    ros.node.create_subscription(RangeCir, RAW, lambda m: received.append((time.time_ns(), m)), 1000)
    # The simulator skips frames that were too weak to be received.
    expected = [(number, np.float32(measured.range_m)) for number, measured in played().items()]
    with board(link) as device:
        # Before the driver connects, the board drops its messages.
        device.pause()
        driver = drive(ros, link)
        connected = ros.diagnosis(
            "driver", lambda s: s.message.startswith("connected") and bool(diagnostic_value(s, LOST))
        )
        with link.open("rb", buffering=0) as port:
            assert termios.tcgetattr(port)[4] == termios.B921600
        device.resume()
        ros.spin_until(lambda: len(received) >= 100)
        published = [(m.sequence, np.float32(m.range)) for _, m in received]
        steps = np.diff([expected.index(item) for item in published]) % len(expected)
        assert (steps >= 1).all()
        # On a busy computer, only the messages that the board reports as dropped are lost.
        lost = int(diagnostic_value(connected, LOST)) + (steps - 1).sum()
        ros.diagnosis("driver", lambda s: int(diagnostic_value(s, LOST) or 0) >= lost)
        assert driver.signal(signal.SIGTERM) == 0, driver.output
    stamps = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in received])
    assert (np.diff(stamps) > 0).all()
    assert all(arrival > stamp for (arrival, _), stamp in zip(received, stamps, strict=True))
    assert "disconnected" not in driver.output, "it has closed the port itself"


def open_files_and_threads(driver: Process) -> tuple[int, int]:
    process = Path("/proc", str(driver.pid))
    return len(os.listdir(process / "fd")), len(os.listdir(process / "task"))


def test_unplugging_leaks_no_descriptors_or_threads(ros: Ros, link: Path):
    received = ros.collect(RangeCir, RAW)
    with board(link, rate_hz=200.0) as device:
        driver = drive(ros, link)
        ros.spin_until(lambda: len(received) >= 10)
        ros.diagnosis("driver", lambda s: fewest(s, "openings", "connections") == 1)
        before = open_files_and_threads(driver)
        for opening in range(2, 6):
            device.unplug()
            ros.spin_until(lambda n=opening: driver.output.count("disconnected from the board") == n - 1)
            device.plug()
            # Older ranges may still arrive: wait until the driver reports the connection.
            ros.diagnosis("driver", lambda s, n=opening: fewest(s, "openings", "connections") >= n)
        # Threads of the last connection may still be ending.
        ros.spin_until(lambda: open_files_and_threads(driver) == before)


def test_driver_survives_resets_noise_and_damage(ros: Ros, link: Path):
    received = ros.collect(RangeCir, RAW)
    faults = Faults(2e-5, 2e-5, 2e-5, lose=0.05, duplicate=0.05)
    true_range_m = {number: np.float32(measured.range_m) for number, measured in played().items()}
    with board(link, rate_hz=200.0, faults=faults, boot_noise=500) as device:
        driver = drive(ros, link)
        for _ in range(3):
            received_before = len(received)
            ros.spin_until(lambda n=received_before: len(received) >= n + 60)
            device.reset()
        device.flood(0.3)
        received_before = len(received)
        ros.spin_until(lambda: len(received) >= received_before + 60)
        status = ros.diagnosis("driver", lambda s: int(diagnostic_value(s, "lost") or 0) > 0)
        # A signal ends it also while noise arrives.
        device.flood(600)
        ros.spin_until(lambda: device.noise_bytes > 50 * FLOOD_BYTES)
        assert driver.signal(signal.SIGINT) == 0, driver.output
    assert all(message.range == true_range_m[message.sequence] for message in received)
    assert status.hardware_id.startswith("board")
    assert "Traceback" not in driver.output


def test_board_corrects_as_the_host_with_the_offsets_of_the_driver(ros: Ros, link: Path):
    """And mode and offsets change without a restart."""
    raw, corrected = ros.collect(RangeCir, RAW), ros.collect(RangeCorrected, CORRECTED)
    host, recorded = Mitigation(load_bundle(default_model_path())), played()

    def is_that_of_the_host(message: RangeCorrected) -> bool:
        (expected,) = host.correct([recorded[message.sequence]])
        values = np.float32([expected.range_m, expected.variance_m2])
        return np.array_equal(np.float32([message.range, message.variance]), values)

    with board(link, model=True, rate_hz=200.0):
        drive(ros, link, "mode:=device", "offsets:=0.25")
        ros.spin_until(lambda: len(corrected) >= 60)
        # All corrections include them, from the first one on.
        host.offsets = Offsets(0.25)
        assert all(map(is_that_of_the_host, corrected))
        assert {(m.source, m.model_id) for m in corrected} == {(CorrectedBy.DEVICE, host.bundle.model_id)}
        # Before the board changes its mode, it may send a few ranges in the old mode.
        assert not stamped_after(raw, to_ns(corrected[0].header.stamp))
        assert ros.set_parameter("driver", "offsets", "-0.5").successful
        host.offsets = Offsets(-0.5)
        corrected.clear()
        ros.spin_until(lambda: len(corrected) >= 20 and all(map(is_that_of_the_host, corrected[-20:])))
        refused = ros.set_parameter("driver", "offsets", 220.0)
        assert not refused.successful
        assert "millimetres" in refused.reason
        ros.start("mitigator").wait_for_output("correcting with model")
        for origin in (CorrectedBy.HOST, CorrectedBy.DEVICE):
            assert ros.set_parameter("driver", "mode", origin.name.lower()).successful
            ros.spin_until(lambda o=origin: [m.source for m in corrected[-20:]] == [o] * 20)
        assert not ros.set_parameter("driver", "mode", "sideways").successful
    keys = [(to_ns(m.header.stamp), m.anchor_id, m.tag_id, m.sequence) for m in corrected]
    assert len(set(keys)) == len(keys)


def test_unusable_port_is_logged_once(ros: Ros, link: Path):
    driver = drive(ros, link)
    absent = f"{link}: is not there (plug the board in); waiting for the radio"
    driver.wait_for_output(absent)
    with board(link):
        driver.wait_for_output("connected to board")
    driver.wait_for_output("disconnected from the board")
    ros.diagnosis("driver", lambda status: status.message.startswith(f"{link}: is not there"))
    ros.spin_until(lambda: driver.output.count(absent) == 2)
    assert driver.signal(signal.SIGINT) == 0
    assert driver.output.count(absent) == 2


def test_port_without_permission_is_reported_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def forbidden(self) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial.Serial, "open", forbidden)
    place = tmp_path / "port"
    place.touch()
    with PortEvents(serial_source, SerialSettings(PortAddress(str(place)))) as events:
        wait_until(lambda: "cannot be opened" in events.port.problem)
        assert "Permission denied" in events.port.problem
        assert "usermod -aG dialout" in events.port.problem


@pytest.mark.parametrize(
    ("radio", "is_warning"),
    [
        (None, True),
        (RadioSettings(), True),
        (RadioSettings(role=Role.ANCHOR), False),
        (RadioSettings(role=Role.ANCHOR, report=True), True),
    ],
)
def test_board_without_ranges_causes_a_warning_unless_it_is_an_anchor(
    radio: RadioSettings | None, is_warning: bool
):
    port = BoardPort(SerialSettings(PortAddress("/dev/no")), (0, None, print, time.time_ns))
    port._observed([RadioConfigured(radio)] if radio is not None else [])
    assert port.report().warning == ("connected; no range yet" if is_warning else "")


def test_board_of_another_protocol_version_is_a_problem_that_names_it():
    port = BoardPort(SerialSettings(PortAddress("/dev/no")), (0, None, print, time.time_ns))
    port._lost = ""
    port._received(FrameEncoder(version=9).encode(1, b""), 0, 0)
    port._received(b"", 4 * 10**9, 0)
    assert port.report().problem == "the board uses another protocol version: 9"
