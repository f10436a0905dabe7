"""What an installation has: each thing that the package needs or can use, looked at by using it.

Nothing is changed. A serial port is not opened, since that resets some boards.
"""

from __future__ import annotations

import enum
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from uwb_mitigation.errors import ModelError
from uwb_mitigation.firmware_export.compiling import c_compiler
from uwb_mitigation.model.shipped import default_model_path, shared_folders

PYTHONS = ((3, 10), (3, 13))


class Library(NamedTuple):
    """A library of Python: what is imported of it, and what it is for; empty = nothing works without it."""

    module: str
    purpose: str = ""


LIBRARIES = {
    "numpy": Library("numpy"),
    "onnxruntime": Library("onnxruntime"),
    "pyyaml": Library("yaml"),
    "cobs": Library("cobs.cobs", "boards on a serial link"),
    "pyserial": Library("serial", "boards on a serial link"),
    "mcap": Library("mcap", "bags"),
    "rosbags": Library("rosbags", "bags"),
    "zstandard": Library("zstandard", "compressed bags"),
    "lz4": Library("lz4.frame", "compressed bags"),
    "onnx": Library("onnx", "training and exporting models"),
    "scipy": Library("scipy", "positions and calibration"),
    "pandas": Library("pandas", "the DeepUWB data set"),
    "pooch": Library("pooch", "fetching data sets"),
    "pydantic": Library("pydantic", "reports"),
    "psutil": Library("psutil", "benches of the nodes"),
    "bokeh": Library("bokeh", "the viewer"),
    "typer": Library("typer", "the command line"),
    "rich": Library("rich", "the command line and the monitor"),
}
"""{distribution: library} of what the package can use and every installation by `make setup` has."""

UDEV_RULE = "60-uwb-mitigation.rules"
UDEV_FOLDERS = (Path("/etc/udev/rules.d"), Path("/usr/lib/udev/rules.d"), Path("/lib/udev/rules.d"))
ROS_PREFIX = Path(os.environ.get("ROS_PREFIX", "/opt/ros/jazzy"))

ASK_RCLPY = "from rclpy.utilities import get_rmw_implementation_identifier as middleware; print(middleware())"
ASK_MESSAGES = """\
from uwb_mitigation_msgs import msg
msg.RangeCir.__class__.__import_type_support__()
print(msg.__path__[0])
"""
CHILD_TIMEOUT_S = 60
_DIALOUT = 'sudo usermod -aG dialout "$USER"'


class State(str, enum.Enum):
    """What a finding means."""

    OK = "ok"
    BROKEN = "broken"
    OPTIONAL = "optional"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at.

    Attributes:
        name: of the thing.
        state: BROKEN is what has to be mended; OPTIONAL what is absent and need not be there.
        detail: version or place, what is wrong, or what an optional thing is for.
        fix: a line for a shell that mends it; empty where there is none.
    """

    name: str
    state: State
    detail: str
    fix: str = ""


def examine() -> Iterator[Finding]:
    """Look at everything, one thing after the other."""
    yield attempt("Python", python_version, "make PYTHON=python3.12 setup")
    yield from (examine_library(name, library) for name, library in LIBRARIES.items())
    yield attempt("shipped model", compare_model, _restored_models())
    yield examine_ros("rclpy", ASK_RCLPY)
    yield examine_ros("messages", ASK_MESSAGES)
    yield from examine_ports()
    yield from examine_udev_rule()
    yield from examine_tools()


def own_environment() -> Path | None:
    """The environment of a checkout that `make setup` made, where this Python is of it."""
    environment = Path(sys.prefix)
    return environment if (environment / "environment.sh").is_file() else None


def examine_library(name: str, library: Library) -> Finding:
    """Broken where it is installed and cannot be imported, or nothing works without it."""
    found = attempt(name, partial(library_version, name, library.module), _installing(name))
    if found.state is State.BROKEN and library.purpose and not _is_installed(name):
        return replace(found, state=State.OPTIONAL, detail=f"for {library.purpose}")
    return found


def library_version(distribution: str, module: str) -> str:
    """The version of a distribution whose module can be imported."""
    import_module(module)
    return metadata.version(distribution)


def _is_installed(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _installing(distribution: str) -> str:
    """The line that installs a library here, without a change of what the system brings."""
    if environment := own_environment():
        return shlex.join(["make", "-C", str(environment.parent), "setup"])
    words = [sys.executable, "-m", "pip", "install"]
    if sys.prefix == sys.base_prefix:
        words.append("--user")
        if Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED").is_file():
            words.append("--break-system-packages")
        constraints = [folder / "ros_constraints.txt" for folder in shared_folders("requirements")]
        words += [word for file in constraints if file.is_file() for word in ("-c", str(file))][:2]
    return shlex.join([*words, distribution])


def _restored_models() -> str:
    """The line that brings the models of a checkout back; those of an installation come with the package."""
    checkout = Path(__file__).resolve().parent.parent
    return (
        shlex.join(["git", "-C", str(checkout), "restore", "models"]) if (checkout / ".git").exists() else ""
    )


def attempt(name: str, look: Callable[[], str], fix: str) -> Finding:
    """What a look finds; BROKEN with the first line of whatever it raises."""
    try:
        return Finding(name, State.OK, look())
    except Exception as error:  # A broken library raises anything, and what it says is what is wanted.
        lines = str(error).strip().splitlines()
        return Finding(name, State.BROKEN, lines[0] if lines else type(error).__name__, fix)


def python_version() -> str:
    """This Python's version; raises RuntimeError where it is not supported."""
    version = ".".join(map(str, sys.version_info[:3]))
    low, high = PYTHONS
    if not low <= sys.version_info[:2] <= high:
        raise RuntimeError(f"{version}: {low[0]}.{low[1]} to {high[0]}.{high[1]} are supported")
    return version


def compare_model() -> str:
    """Load the shipped model, and compare ONNX Runtime with the integer reference bit by bit where onnx can read it."""
    import numpy as np

    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.runtime import Session

    bundle = load_bundle(default_model_path())
    name = f"{bundle.card.name}, id {bundle.model_id:08x}"
    session = Session(bundle)
    if not _is_installed("onnx"):
        return f"{name}: loaded, not compared with the integer reference"
    from uwb_mitigation.firmware_export.export import golden_windows
    from uwb_mitigation.firmware_export.packing import pack
    from uwb_mitigation.model import graph
    from uwb_mitigation.model.integer import IntegerNetwork

    weights = graph.int8_weights(bundle.model, bundle.architecture)
    windows = golden_windows(pack(weights))
    given, golden = session.predict_batch_m(windows), IntegerNetwork(weights).predict_m(windows)
    wrong = int(np.sum(given.view(np.uint32) != golden.view(np.uint32)))
    if wrong:
        raise RuntimeError(f"ONNX Runtime computes {wrong} of {len(windows)} golden vectors differently")
    return f"{name}: {len(windows)} golden vectors equal to the bit"


def examine_ros(name: str, code: str) -> Finding:
    """Run `code`, which needs ROS: as things are, or else after a script that sets ROS up has been sourced."""
    scripts = _setup_scripts()
    found = attempt(name, partial(ask_child, code), "")
    for script in scripts:
        if found.state is State.OK:
            break
        found = attempt(name, partial(ask_child, code, script), "")
        if found.state is State.OK:
            told = f"{found.detail}, once its script is sourced"
            return replace(found, detail=told, fix=f". {shlex.quote(str(script))}")
    if found.state is State.OK:
        return found
    if environment := own_environment():
        return replace(found, fix=shlex.join(["make", "-C", str(environment.parent), "setup"]))
    if scripts or os.environ.get("AMENT_PREFIX_PATH") or find_spec("rclpy"):
        build = "colcon build --base-paths src src/uwb_mitigation/msg_defs && . install/setup.sh"  # in the workspace
        return replace(found, fix=build if name == "messages" else "")
    return replace(found, state=State.OPTIONAL, detail="for the nodes: there is no ROS 2 Jazzy here")


def _setup_scripts() -> list[Path]:
    """Scripts that set ROS up: of this environment, of the workspace that holds this package, and ROS's own."""
    # install/uwb_mitigation/lib/python3.x/site-packages/uwb_mitigation, or install/lib/... where it is merged.
    prefixes = list(Path(__file__).resolve().parents[3:7])
    scripts = [Path(sys.prefix) / "environment.sh"]
    scripts += [prefix / "setup.sh" for prefix in prefixes if (prefix / "_local_setup_util_sh.py").is_file()]
    scripts.append(ROS_PREFIX / "setup.sh")
    return [script for script in scripts if script.is_file()]


def ask_child(code: str, script: Path | None = None) -> str:
    """What Python prints on running `code`, after `script` where given. ROS ends the process that cannot load
    its middleware."""
    command = [sys.executable, "-c", code]
    if script is not None:
        command = ["sh", "-c", '. "$0" && exec "$@"', str(script), *command]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=CHILD_TIMEOUT_S)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"did not answer within {CHILD_TIMEOUT_S} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise RuntimeError(lines[-1] if lines else f"exit code {done.returncode}")
    return done.stdout.strip()


def examine_ports() -> Iterator[Finding]:
    """The serial ports, and whether they may be opened."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return  # told above
    ports = sorted(list_ports.comports())
    if not ports:
        yield Finding("serial ports", State.OPTIONAL, "no board is plugged in")
    for port in ports:
        if os.access(port.device, os.R_OK | os.W_OK):
            yield Finding(port.device, State.OK, port.description)
        else:
            # Without USB it is the computer's own port, where there is rarely a board.
            state = State.OPTIONAL if port.vid is None else State.BROKEN
            yield Finding(port.device, state, "permission denied; after the fix, log in again", _DIALOUT)


def examine_udev_rule() -> Iterator[Finding]:
    """The rule that names boards, where it was copied to, or how to copy it."""
    for folder in UDEV_FOLDERS:
        if (folder / UDEV_RULE).is_file():
            yield Finding("udev rule", State.OK, str(folder / UDEV_RULE))
            return
    try:
        source = default_model_path().parent.parent / "udev" / UDEV_RULE
    except ModelError:
        return  # nothing of the package's shared files is there, as told above
    copy = shlex.join(["sudo", "cp", str(source), str(UDEV_FOLDERS[0])])
    fix = f"{copy} && sudo udevadm control --reload && sudo udevadm trigger"
    yield Finding("udev rule", State.OPTIONAL, "names boards /dev/uwb/SERIAL, keeps ModemManager away", fix)


def examine_tools() -> Iterator[Finding]:
    """What is optional: torch, compilers, the emulator."""
    environment = own_environment()
    torch = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "torch",
        "--index-url",
        "https://download.pytorch.org/whl/cpu",
    ]
    training = ["make", "-C", str(environment.parent), "setup-training"] if environment else torch
    # Not imported: that takes seconds.
    yield _optional("torch", partial(metadata.version, "torch"), "for training", shlex.join(training))
    compiler = "mitigator with backend:=firmware"
    yield _optional("C compiler", lambda: " ".join(c_compiler()), compiler, "sudo apt-get install gcc")
    purposes = {
        "arm-none-eabi-gcc": ("builds the firmware", "gcc-arm-none-eabi libnewlib-arm-none-eabi"),
        "qemu-system-arm": ("runs the firmware without a board", "qemu-system-arm"),
    }
    for tool, (purpose, packages) in purposes.items():
        yield _optional(tool, partial(find_tool, tool), purpose, f"sudo apt-get install {packages}")


def _optional(name: str, look: Callable[[], str], purpose: str, fix: str) -> Finding:
    found = attempt(name, look, fix)
    return found if found.state is State.OK else replace(found, state=State.OPTIONAL, detail=purpose)


def find_tool(name: str) -> str:
    """Where a program is; raises RuntimeError where it is not."""
    place = shutil.which(name)
    if place is None:
        raise RuntimeError("not found")
    return place
