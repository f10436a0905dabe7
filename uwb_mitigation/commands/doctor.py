"""`uwb-mitigation doctor`: checks each part of the installation by using it; opens no serial ports."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module, metadata
from typing import NamedTuple

from rich.markup import escape
from rich.table import Column, Table

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption
from uwb_mitigation.errors import UwbMitigationError

LIBRARIES = {
    "": ("numpy", "onnxruntime", "pyyaml"),
    "boards on a serial link": ("cobs", "pyserial"),
    "bags": ("mcap", "rosbags", "zstandard", "lz4"),
    "models, positions and recordings": ("onnx", "scipy", "pydantic", "pandas"),
    "the command line, the viewer and benchmarks": ("typer", "rich", "bokeh", "psutil"),
}
"""{purpose: required libraries}; the first entry is required by everything."""

MODULES = {"pyyaml": "yaml", "pyserial": "serial"}
_TOOLS = {
    "gcc": "mitigator with backend:=firmware",
    "arm-none-eabi-gcc": "building the firmware",
    "qemu-system-arm": "running the firmware without a board",
}


class Finding(NamedTuple):
    """Result of one check; `state` is ok, broken or optional (missing, and not required)."""

    name: str
    state: str
    detail: str


def doctor(json: JsonOption = None) -> None:
    """Check the installation. The exit code is 1 if something is broken."""
    findings = list(examine())
    table = Table("component", "state", Column("details", overflow="fold"))
    for name, state, detail in findings:
        table.add_row(name, {"ok": "[green]ok", "broken": "[red]broken"}.get(state, state), escape(detail))
    console.out.print(table)
    broken = [name for name, state, _ in findings if state == "broken"]
    console.write_json(json, {"ok": not broken, "findings": findings})
    if broken:
        remedy = "run `make setup` in the checkout, or install the named packages"
        raise UwbMitigationError(f"broken: {', '.join(broken)}", valid=remedy)
    console.out.print("No problems found.")


def examine() -> Iterator[Finding]:
    """Yield a finding for each library, tool, model, ROS package and port."""
    for purpose, names in LIBRARIES.items():
        yield from (_check(name, partial(_version, name), name, purpose) for name in names)
    yield _check("shipped model", _compare_model)
    yield _check("ROS 2", _load_ros, "rclpy", "the nodes: source ROS and the workspace, or run make setup")
    yield from _ports()
    yield _check("h5py", partial(_version, "h5py"), "h5py", "recordings in HDF5: pip install h5py")
    yield _check("torch", partial(metadata.version, "torch"), "torch", "training: make setup-training")
    for tool, use in _TOOLS.items():
        path = shutil.which(tool)
        yield Finding(tool, "ok" if path else "optional", path or f"for {use}")


def _check(name: str, look: Callable[[], str], distribution: str = "", purpose: str = "") -> Finding:
    """Run one check. A distribution with a purpose is optional: it may be missing, but not broken."""
    try:
        return Finding(name, "ok", look())
    except Exception as error:  # A broken library raises anything.
        if purpose and not list(metadata.distributions(name=distribution)):
            return Finding(name, "optional", f"not installed; for {purpose}")
        return Finding(name, "broken", (str(error).strip().splitlines() or [type(error).__name__])[-1])


def _version(distribution: str) -> str:
    import_module(MODULES.get(distribution, distribution))
    return metadata.version(distribution)


def _load_ros() -> str:
    """Load ROS in a separate process, since it aborts the process if it cannot load its middleware."""
    command = [sys.executable, "-m", "uwb_mitigation.nodes.support.middleware"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if result.returncode:
        raise RuntimeError(result.stderr or f"exit code {result.returncode}")
    return result.stdout.strip()


def _compare_model() -> str:
    from uwb_mitigation.mitigation.embedded.export import compare_with_reference
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import default_model_path

    bundle = load_bundle(default_model_path())
    if wrong := compare_with_reference(bundle):
        raise RuntimeError(f"{wrong} test vectors differ from the integer reference")
    return f"{bundle.card.name}, bit-identical with the integer reference"


def _ports() -> Iterator[Finding]:
    try:
        from serial.tools import list_ports
    except ImportError:
        return  # reported above
    for port in sorted(list_ports.comports()):
        if os.access(port.device, os.R_OK | os.W_OK):
            yield Finding(port.device, "ok", port.description)
        elif port.vid is not None:  # A port without USB is built in, and rarely has a board.
            yield Finding(port.device, "broken", "permission denied: join the group dialout, log in again")
