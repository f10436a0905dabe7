"""Shared fixtures."""

from __future__ import annotations

import os

# Set this before numpy is imported. Tests run in parallel, so more threads do not help.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import atexit
import fcntl
import gc
import re
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import Browser, chromium
from drives import HALL
from hypothesis import HealthCheck, settings

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
    "site_page viewer_page calibrate_command tutorial tracking viewer_node viewer_verdict self_calibration "
    "locator_odometry px4 viewer_recordings robot_localization demos positioning robot_estimator firmware_parity "
    "firmware_emulator robots_under_load field_report locator viewer_playback frames topic_source nodes reliability "
    "experiments public_api model_choice process"
)
"""Files that start first, so that none of them runs alone at the end."""


SLOW = re.compile(
    r"rclpy|torch|_msgs\.msg |from browser|selenium|compil|command_line|benchmarks\.paper|calibration\.s"
)
"""Words in the files that `--fast` leaves out: of ROS, PyTorch, a browser, a compiler, commands, and many drives."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="only quick tests without ROS and torch")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--fast"):
        config.option.markexpr = "not ros and not slow"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    is_file = config.getoption("--fast") and collection_path.match("test_*.py")
    return True if is_file and SLOW.search(collection_path.read_text(encoding="utf-8")) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Import without the garbage collector, and let it ignore the modules from then on: Bokeh calls it for each closed page."""
    gc.disable()
    collected = yield
    gc.collect()
    gc.freeze()
    gc.enable()
    return collected


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {f"test_{name}": place for place, name in enumerate(LONGEST.split())}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Return one browser for all tests of a worker, because it takes seconds to start."""
    with chromium() as window:
        yield window


@pytest.fixture(scope="session")
def data(pytestconfig: pytest.Config) -> Path:
    """Return the folder of the data sets; skip the test if it is missing, or with `--fast`."""
    if pytestconfig.getoption("--fast"):
        pytest.skip("reads recordings")
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
    """Return a folder with `apartment.mcap`, `import.json` and `printed.txt` of `data import`, made once for all workers."""
    from command_line import succeed  # Quick tests do not need the commands.

    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder = shared / "apartment_imported"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "printed.txt").exists():
            folder.mkdir(exist_ok=True)
            options = "-o apartment.mcap --longest-pause inf --json import.json"
            done = succeed("data", "import", apartment, *options.split(), folder=folder)
            (folder / "printed.txt").write_text(done.stdout)
    return folder


@pytest.fixture(scope="session")
def apartment_reading(apartment_imported: Path) -> list[Record]:
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
