"""Shared fixtures."""

from __future__ import annotations

import os

# Set this before numpy is imported. Tests run in parallel, so more threads do not help.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import atexit
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import Browser, chromium
from drives import HALL
from fast import SLOW_FIXTURES, is_fast
from hypothesis import HealthCheck, settings
from real_logs import import_once

from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.anchors import dump_anchors

if TYPE_CHECKING:
    from ros_harness import Ros

    from uwb_mitigation.types.measurement import Record

# If a script starts pytest in the background, SIGINT is ignored, also by the processes of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)

# What drivers keep after a crash does not belong into the user's home.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="uwb_mitigation_test_")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

# Use the same examples in each run, and no deadline.
settings.register_profile(
    "suite", deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("suite")

REPOSITORY = Path(__file__).resolve().parent.parent

LONGEST = (
    "site_page self_calibration tracking viewer_page viewer_node calibrate_command tutorial viewer_recordings "
    "robot_estimator firmware_emulator paper_experiment firmware_parity firmware_arduino_build "
    "robot_localization positioning locator_odometry viewer_playback serial_driver survey_anchors training px4 process"
)
"""Files that start first, so that none of them runs alone at the end."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fast", action="store_true", help="only quick tests without ROS and torch, see fast.py"
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    if config.getoption("--fast") and collection_path.match("test_*.py") and not is_fast(collection_path):
        return True
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    order = {f"test_{name}": place for place, name in enumerate(LONGEST.split())}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))
    if not config.getoption("--fast"):
        return
    slow = [
        item
        for item in items
        if {mark.name for mark in item.iter_markers()} & {"ros", "slow"}
        or SLOW_FIXTURES & set(getattr(item, "fixturenames", ()))
    ]
    config.hook.pytest_deselected(items=slow)
    items[:] = [item for item in items if item not in slow]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Return one browser for all tests of a worker, because it takes seconds to start."""
    with chromium() as window:
        yield window


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the data sets; skip the test if it is missing."""
    root = Path(os.environ.get("UWB_MITIGATION_DATA", REPOSITORY.parent / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"the data sets are not at {root}: set UWB_MITIGATION_DATA to run this test")
    return root


@pytest.fixture(scope="session")
def apartment(data: Path) -> Path:
    """Return the folder of real EVK1000 logs; skip the test if it is missing."""
    folder = data / "evk1000_apartment"
    if not (folder / "logs").is_dir():
        pytest.skip(f"the EVK1000 logs are not at {folder}")
    return folder


@pytest.fixture(scope="session")
def apartment_imported(apartment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the real logs in `apartment.mcap`, which is read faster; see `import_once`."""
    return import_once(apartment, tmp_path_factory)


@pytest.fixture(scope="session")
def apartment_reading(apartment_imported: Path) -> list[Record]:
    """Return all exchanges of the real logs."""
    return list(McapRecording(apartment_imported / "apartment.mcap"))


@pytest.fixture
def anchors(tmp_path: Path) -> Path:
    """Return a file with the anchors of `HALL`."""
    path = tmp_path / "hall anchors.yaml"
    path.write_text(dump_anchors(HALL))
    return path


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """Return a separate DDS domain with a client."""
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    from ros_harness import domain

    with domain(tmp_path) as ros:
        yield ros
