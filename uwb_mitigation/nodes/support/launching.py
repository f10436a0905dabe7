"""The arguments of the launch files: one for each parameter of the nodes, checked before a node starts. No ROS here."""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from uwb_mitigation.errors import ParameterError, UwbMitigationError, check_name, did_you_mean
from uwb_mitigation.nodes.support.parameter_tables import (
    RESPAWN_FOLDER,
    STANDARD,
    TABLES,
    Parameter,
    ParameterValue,
)

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")

_WILDCARDS = ("*", "**", "/*", "/**")
"""Sections of a parameter file that apply to every node."""

_LAUNCH_FILES = (".launch.py", ".launch.xml", ".launch.yaml", ".launch.yml")
_OWN_LAUNCH_FILES = ("uwb.launch.py", "boards.launch.py")

_PARSERS: dict[type, Callable[[str], ParameterValue]] = {
    bool: lambda text: {"true": True, "false": False}[text.lower()],
    int: lambda text: int(text, 0),
    float: float,
    str: str,
}


def report_errors(function: Callable[[Any], list[Any]]) -> Callable[[Any], list[Any]]:
    """Make a launch function raise RuntimeError, which `ros2 launch` reports in one line, and then stops."""

    @functools.wraps(function)
    def wrapped(context: Any) -> list[Any]:
        try:
            return function(context)
        except UwbMitigationError as error:
            raise RuntimeError(str(error)) from None

    return wrapped


def arguments(nodes: Iterable[str]) -> dict[str, dict[str, Parameter]]:
    """Return the arguments of a launch file, {argument: {node: parameter}}.

    An argument has the name of its parameter and applies to every node with that parameter. If parameters of
    one name differ in their defaults, they are different parameters: the later node's argument is NODE_PARAMETER.
    """
    rows_by_argument: dict[str, dict[str, Parameter]] = {}
    for node in nodes:
        for row in TABLES[node]:
            rows = rows_by_argument.setdefault(row.name, {})
            if any(earlier_row.default != row.default for earlier_row in rows.values()):
                rows = rows_by_argument.setdefault(f"{node}_{row.name}", {})
            rows[node] = row
    return rows_by_argument


def description(rows: Mapping[str, Parameter]) -> str:
    """Return the line of an argument for `--show-args`."""
    row = next(iter(rows.values()))
    default = "" if not row.filed else f" Default: {row.default_text}."
    return f"{row.description.rstrip('.')} ({row.valid}; {', '.join(rows)}).{default}"


def parameters(
    texts: Mapping[str, str], nodes: Collection[str], argument_nodes: Iterable[str]
) -> dict[str, dict[str, Any]]:
    """Return the parameters that arguments set, {node: {parameter: value}}.

    Args:
        texts: {argument: text}; an empty text keeps the value of the files.
        nodes: the nodes that are started.
        argument_nodes: the nodes whose parameters are arguments.

    Raises:
        ParameterError: a value is invalid, or for a node that is not started.
    """
    values: dict[str, dict[str, Any]] = {node: {} for node in nodes}
    for name, rows in arguments(argument_nodes).items():
        text = texts.get(name, "")
        if not text:
            continue
        started = [node for node in rows if node in nodes]
        if not started:
            raise ParameterError(
                f"argument {name}:={text} is for the {' or '.join(rows)}, which is not started",
                valid="locate:=true starts the locator, viewer:=true the viewer, source:=... the driver",
            )
        for node in started:
            values[node][rows[node].name] = value_of(rows[node], text)
    return values


def quoted(values: Mapping[str, ParameterValue]) -> dict[str, ParameterValue]:
    """Return parameters for launch_ros, which reads a text as YAML: a text such as 1234 needs quotes."""
    return {name: json.dumps(value) if isinstance(value, str) else value for name, value in values.items()}


def value_of(row: Parameter, text: str) -> ParameterValue:
    """Return the value of a parameter from the text of an argument.

    Raises:
        ParameterError: the text is not a valid value.
    """
    value: ParameterValue = text
    kinds = (int, float) if row.or_number else (type(row.default),)
    for kind in kinds:
        with contextlib.suppress(ValueError, KeyError):
            value = _PARSERS[kind](text)
            break
    if row.or_number and isinstance(value, int) and abs(value) >= 1 << 63:
        # ROS integers are signed: an address of 64 bits stays a string.
        value = text
    if row.or_number and isinstance(value, str):
        # In quotes, as on the command line.
        value = value.strip("'\"")
    row.check(value)
    return value


def choice(name: str, text: str, choices: Sequence[str] = ("true", "false")) -> str:
    """Return the value of an argument in lower case; raise ParameterError if it is not one of the choices."""
    if text.lower() not in choices:
        valid, suggestion = f"one of {', '.join(choices)}", did_you_mean(text, choices)
        raise ParameterError(f"argument {name}:={text}", valid=valid, suggestion=suggestion)
    return text.lower()


def check_names(words: Sequence[str], declared: Collection[str]) -> None:
    """Raise ParameterError for an argument of `ros2 launch` that the launch file does not declare.

    Args:
        words: the command-line arguments after the name of the launch file.
        declared: the declared arguments.
    """
    # A launch file that includes this one may declare further arguments.
    if any(word.endswith(_LAUNCH_FILES) and Path(word).name not in _OWN_LAUNCH_FILES for word in sys.argv):
        return
    for word in words:
        name, separator, _ = word.partition(":=")
        if separator:
            check_name("argument", name, declared, valid="--show-args lists them")


def installed(package: str, file: str) -> Path | None:
    """Return the path of a file of an installed ROS package; None: it is in no prefix of AMENT_PREFIX_PATH."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    paths = (Path(prefix, "share", package, file) for prefix in prefixes)
    return next(filter(Path.is_file, paths), None)


def check_package(argument: str, package: str) -> None:
    """Check that a ROS package is installed.

    Args:
        argument: launch argument that needs it.
        package: its name.

    Raises:
        ParameterError: it is not in any prefix of AMENT_PREFIX_PATH.
    """
    if installed(package, "package.xml") is None:
        name = package.replace("_", "-")
        raise ParameterError(
            f"{argument}:=true needs {package}, which is not installed",
            valid=f"sudo apt install ros-jazzy-{name}",
        )


def check_driver(values: Mapping[str, Any]) -> None:
    """Raise ParameterError if the source needs a port or a recording, and none is given, or the recording is missing."""
    serial = ("port", "/dev/ttyACM0")
    captured = ("path" if values.get("path") else "port", "/dev/ttyACM0")
    needed = {
        "serial": serial,
        "evb1000": serial,
        **dict.fromkeys(("uci", "lines", "pans"), captured),
        "spi": ("port", "/dev/spidev0.0"),
        "mcap": ("path", "FILE"),
        "decaranging": ("path", "FILE"),
        "topic": ("map", "nlink_nodeframe2"),
    }
    source = values.get("source")
    name, example = needed.get(str(source), ("", ""))
    if name and not values.get(name):
        raise ParameterError(f"source {source} without a {name}", valid=f"{name}:={example}")
    if name == "path" and not Path(str(values["path"])).expanduser().exists():
        raise ParameterError(f"parameter path = {values['path']}: no such file or folder")


def from_files(node: str, node_file: str, shared: str = "") -> dict[str, Any]:
    """Return the parameters that the files of a node set.

    Args:
        node: name of the node.
        node_file: path of the file for this node.
        shared: path of a file for all nodes, which overrides the other; may be empty.

    Raises:
        ParameterError: a file cannot be read, or a parameter in it is unknown or invalid.
    """
    values = _parameters_in(Path(node_file), node, ())
    return values | _parameters_in(Path(shared), node, conflicting_parameters(node)) if shared else values


def conflicting_parameters(node: str) -> dict[str, ParameterValue]:
    """Return the parameters whose names have another meaning for an earlier node, such as the viewer's port.

    In the section for all nodes of a shared file they belong to that earlier node, as arguments do.

    Returns:
        {parameter: default}
    """
    node_rows = [(name, rows[node]) for name, rows in arguments(TABLES).items() if node in rows]
    return {row.name: row.default for name, row in node_rows if row.name != name}


def separate_conflicts(
    values: dict[str, dict[str, Any]], file_values: Mapping[str, Mapping[str, Any]]
) -> None:
    """Set the parameters of each node that a file for all nodes gives to an earlier node, in place.

    Args:
        values: {node: {parameter: value}} of the started nodes, from the arguments.
        file_values: those of the files.
    """
    for node in values:
        defaults = conflicting_parameters(node)
        values[node] = {
            name: file_values[node].get(name, default) for name, default in defaults.items()
        } | values[node]


def _parameters_in(path: Path, node: str, excluded: Collection[str]) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else " ".join(str(error).split())
        raise ParameterError(f"parameter file {path}: {reason}") from error
    values: dict[str, Any] = {}
    all_names = {row.name for table in TABLES.values() for row in table}
    rows = {row.name: row for row in TABLES[node]}
    for section, name, value in _entries(tree, ""):
        if section in _WILDCARDS:
            if name in excluded:
                continue
        elif section.rpartition("/")[2] != node:
            continue
        if name in rows:
            try:
                rows[name].check(value)
            except ParameterError as error:
                error.where = str(path)
                raise
            values[name] = value
        elif name not in all_names and not name.startswith(STANDARD):
            check_name("parameter", name, all_names, str(path), "`ros2 launch ... --show-args` lists them")
    return values


def respawn_environment() -> dict[str, str]:
    """Return the environment that lets a respawned node continue with its parameters and state."""
    folder = tempfile.mkdtemp(prefix="uwb_mitigation_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {RESPAWN_FOLDER: folder}


def _entries(tree: Any, section: str) -> Iterator[tuple[str, str, Any]]:
    """Yield section, name and value of every parameter in a file."""
    for key, branch in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters":
            yield from ((section, name, value) for name, value in _flat(branch, ""))
        else:
            yield from _entries(
                branch, str(key) if str(key) in _WILDCARDS else f"{section}/{key}".lstrip("/")
            )


def _flat(branch: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in branch.items() if isinstance(branch, dict) else ():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
