"""What an installation has: each thing that the package needs or can use, looked at by using it.

Nothing is changed. A serial port is not opened, since that resets some boards.
"""

from __future__ import annotations

import enum
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module, metadata
from pathlib import Path

from uwb_mitigation.errors import ModelError
from uwb_mitigation.firmware_export.compiling import c_compiler
from uwb_mitigation.model.shipped import default_model_path

PYTHONS = ((3, 10), (3, 13))
PACKAGES = {
    "numpy": "numpy",
    "onnxruntime": "onnxruntime",
    "onnx": "onnx",
    "mcap": "mcap",
    "zstandard": "zstandard",
    "lz4": "lz4.frame",
    "rosbags": "rosbags",
    "pyyaml": "yaml",
    "pooch": "pooch",
    "cobs": "cobs.cobs",
    "pyserial": "serial",
}
"""Distributions that the command line and the nodes need, and what is imported of each."""

UDEV_RULE = "60-uwb-mitigation.rules"
UDEV_FOLDERS = (Path("/etc/udev/rules.d"), Path("/usr/lib/udev/rules.d"), Path("/lib/udev/rules.d"))

_SETUP = "make setup, or install requirements/runtime.txt"
_ROS = "make setup, or source ROS's setup.sh and that of the workspace"
_RCLPY = "from rclpy.utilities import get_rmw_implementation_identifier as middleware; print(middleware())"
_MESSAGES = """\
from uwb_mitigation_msgs import msg
msg.RangeCir.__class__.__import_type_support__()
print(msg.__path__[0])
"""
CHILD_TIMEOUT_S = 60
_DIALOUT = "sudo usermod -aG dialout $USER, then log in again"


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
        fix: what to do; empty where there is nothing to do.
    """

    name: str
    state: State
    detail: str
    fix: str = ""


def examine() -> Iterator[Finding]:
    """Look at everything, one thing after the other."""
    yield _attempt("Python", _python, "make PYTHON=python3.12 setup")
    packages = [_attempt(name, partial(_package, name, module), _SETUP) for name, module in PACKAGES.items()]
    yield from packages
    complete = all(package.state is State.OK for package in packages)
    yield _attempt("shipped model", _model, "install the package again" if complete else _SETUP)
    yield _attempt("rclpy", partial(_child, _RCLPY), _ROS)
    yield _attempt("messages", partial(_child, _MESSAGES), _ROS)
    yield from _ports()
    yield from _udev_rule()
    yield from _tools()


def distribution_of(module: str) -> str | None:
    """Which of `PACKAGES` a module is of; None: of none."""
    top = module.partition(".")[0]
    return next((name for name, imported in PACKAGES.items() if imported.partition(".")[0] == top), None)


def _attempt(name: str, look: Callable[[], str], fix: str) -> Finding:
    try:
        return Finding(name, State.OK, look())
    except Exception as error:  # A broken library raises anything, and what it says is what is wanted.
        lines = str(error).strip().splitlines()
        return Finding(name, State.BROKEN, lines[0] if lines else type(error).__name__, fix)


def _python() -> str:
    version = ".".join(map(str, sys.version_info[:3]))
    low, high = PYTHONS
    if not low <= sys.version_info[:2] <= high:
        raise RuntimeError(f"{version}: {low[0]}.{low[1]} to {high[0]}.{high[1]} are supported")
    return version


def _package(distribution: str, module: str) -> str:
    import_module(module)
    return metadata.version(distribution)


def _model() -> str:
    """Load the shipped model and compare ONNX Runtime with the integer reference, bit by bit."""
    import numpy as np

    from uwb_mitigation.firmware_export.export import golden_windows
    from uwb_mitigation.firmware_export.packing import pack
    from uwb_mitigation.model import graph
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.integer import IntegerNetwork
    from uwb_mitigation.model.session import Session

    bundle = load_bundle(default_model_path())
    weights = graph.int8_weights(bundle.model, bundle.architecture)
    windows = golden_windows(pack(weights))
    given, golden = Session(bundle).predict_batch_m(windows), IntegerNetwork(weights).predict_m(windows)
    wrong = int(np.sum(given.view(np.uint32) != golden.view(np.uint32)))
    if wrong:
        raise RuntimeError(f"ONNX Runtime computes {wrong} of {len(windows)} golden vectors differently")
    return f"{bundle.card.name}, id {bundle.model_id:08x}: {len(windows)} golden vectors equal to the bit"


def _child(code: str) -> str:
    """What Python prints on running `code`. ROS ends the process that cannot load its middleware."""
    command = [sys.executable, "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=CHILD_TIMEOUT_S)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"did not answer within {CHILD_TIMEOUT_S} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise RuntimeError(lines[-1] if lines else f"exit code {done.returncode}")
    return done.stdout.strip()


def _ports() -> Iterator[Finding]:
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
            yield Finding(port.device, state, "permission denied", _DIALOUT)


def _udev_rule() -> Iterator[Finding]:
    for folder in UDEV_FOLDERS:
        if (folder / UDEV_RULE).is_file():
            yield Finding("udev rule", State.OK, str(folder / UDEV_RULE))
            return
    try:
        source = default_model_path().parent.parent / "udev" / UDEV_RULE
    except ModelError:
        return  # nothing of the package's shared files is there, as told above
    fix = f"sudo cp {source} {UDEV_FOLDERS[0]} && sudo udevadm control --reload && sudo udevadm trigger"
    yield Finding("udev rule", State.OPTIONAL, "names boards /dev/uwb/SERIAL", fix)


def _tools() -> Iterator[Finding]:
    # Not imported: that takes seconds.
    yield _optional("torch", partial(metadata.version, "torch"), "for training", "make setup-training")
    compiler = "mitigator with backend:=firmware"
    yield _optional("C compiler", lambda: " ".join(c_compiler()), compiler, "apt install gcc, or set CC")
    purposes = {
        "arm-none-eabi-gcc": ("builds the firmware", "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi"),
        "qemu-system-arm": ("runs the firmware without a board", "apt install qemu-system-arm"),
    }
    for tool, (purpose, fix) in purposes.items():
        yield _optional(tool, partial(_tool, tool), purpose, fix)


def _optional(name: str, look: Callable[[], str], purpose: str, fix: str) -> Finding:
    found = _attempt(name, look, fix)
    return found if found.state is State.OK else replace(found, state=State.OPTIONAL, detail=purpose)


def _tool(name: str) -> str:
    place = shutil.which(name)
    if place is None:
        raise RuntimeError("not found")
    return place
