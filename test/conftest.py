"""Fixtures that more than one test module uses."""

from __future__ import annotations

import os

# Before numpy is loaded. Tests run side by side: threads that wait for each other only take time from the next test.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import Browser, chromium
from fast import SLOW_FIXTURES, is_fast
from hypothesis import HealthCheck, settings
from real_logs import Reading, read_once

from benchmarks.dw1000_model.air import Air

if TYPE_CHECKING:
    from ros_harness import Ros

# A suite that a script starts in the background ignores SIGINT, and so would all that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples every time, however slow the computer is.
settings.register_profile(
    "suite", deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("suite")

REPOSITORY = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fast", action="store_true", help="only quick tests without ROS and torch, see fast.py"
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    is_slow_file = collection_path.match("test_*.py") and not is_fast(collection_path)
    return True if config.getoption("--fast") and is_slow_file else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
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
    """One browser for all tests of a worker, because it takes seconds to start."""
    with chromium() as window:
        yield window


@pytest.fixture(scope="session")
def apartment() -> Path:
    """The folder of real EVK1000 logs; skips, and says so, where it is absent."""
    root = Path(os.environ.get("UWB_MITIGATION_DATA", REPOSITORY.parent / "shared" / "data"))
    folder = root / "evk1000_apartment"
    if not (folder / "logs").is_dir():
        pytest.skip(f"the EVK1000 logs are not at {folder}: set UWB_MITIGATION_DATA to run this test")
    return folder


@pytest.fixture(scope="session")
def apartment_reading(apartment: Path, tmp_path_factory: pytest.TempPathFactory) -> Reading:
    """All exchanges of the real logs, and what was odd."""
    return read_once(apartment, tmp_path_factory)


@pytest.fixture
def air() -> Iterator[Air]:
    """Where a test puts modelled chips; it needs a C compiler."""
    with Air(1) as air:
        yield air


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """A DDS domain of the test's own, with a client in it."""
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    from ros_harness import domain

    with domain(tmp_path) as ros:
        yield ros
