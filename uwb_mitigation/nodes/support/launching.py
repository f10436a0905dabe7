"""The arguments of the launch files: one for each parameter of the nodes, which check them. Only `on_exit` imports launch."""

from __future__ import annotations

import atexit
import shutil
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from uwb_mitigation.errors import ParameterError, check_name
from uwb_mitigation.nodes.support import parameter_tables as tables

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
BOOLEANS = ("true", "false", "True", "False")

_WILDCARDS = ("*", "**", "/*", "/**")
"""Sections of a parameter file that apply to every node."""

_LAUNCH_FILES = (".launch.py", ".launch.xml", ".launch.yaml", ".launch.yml")
_OWN_LAUNCH_FILES = ("uwb.launch.py", "boards.launch.py")


def on_exit(event: Any, context: object) -> list[Any]:
    """Handle the exit of a node during its `respawn_delay`, so that only a crashed node is respawned.

    If the launch process stalls for longer than the delay, `RespawnState` lets a driver end again.

    Args:
        event: `ProcessExited`. Code 0 or `DAMAGED`: the node ended, for example after a recording.
        context: unused.

    Raises:
        RuntimeError: code `REFUSED`. The launch stops, and `ros2 launch` exits with 1.
    """
    from launch.actions import EmitEvent
    from launch.events import matches_action
    from launch.events.process import ShutdownProcess

    if event.returncode == tables.REFUSED:
        raise RuntimeError(f"{event.process_name} refused its start: see its error above")
    if event.returncode in (0, tables.DAMAGED):
        return [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(event.action)))]
    return []


def arguments(nodes: Iterable[str]) -> dict[str, dict[str, tables.Parameter]]:
    """Return the arguments of a launch file, {argument: {node: parameter}}.

    An argument has the name of its parameter and applies to every node with that parameter. If parameters of
    one name differ in their defaults, they are different parameters: the later node's argument is NODE_PARAMETER.
    """
    rows_by_argument: dict[str, dict[str, tables.Parameter]] = {}
    for node in nodes:
        for row in tables.TABLES[node]:
            rows = rows_by_argument.setdefault(row.name, {})
            if any(earlier_row.default != row.default for earlier_row in rows.values()):
                rows = rows_by_argument.setdefault(f"{node}_{row.name}", {})
            rows[node] = row
    return rows_by_argument


def description(rows: Mapping[str, tables.Parameter]) -> str:
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
        ParameterError: an argument is for a node that is not started.
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


def value_of(row: tables.Parameter, text: str) -> tables.ParameterValue:
    """Return the value of a parameter from the text of an argument; a text of another type is left to the node."""
    try:
        if isinstance(row.default, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(row.default, int):
            return int(text, 0)
        if isinstance(row.default, float):
            return float(text)
    except (KeyError, ValueError):
        return text
    # An address may be in quotes, as on the command line of a node.
    return text.strip("'\"") if row.or_number else text


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


def from_files(node: str, node_file: str, shared: str = "") -> dict[str, Any]:
    """Return the parameters that the files of a node set; the node checks them.

    Args:
        node: name of the node.
        node_file: path of the file for this node.
        shared: path of a file for all nodes, which overrides the other; may be empty.
    """
    values = {name: value for _, name, value in _entries_of(node, node_file)}
    conflicts = conflicting_parameters(node)
    shared_entries = _entries_of(node, shared) if shared else ()
    return values | {
        name: value
        for section, name, value in shared_entries
        if section not in _WILDCARDS or name not in conflicts
    }


def conflicting_parameters(node: str) -> dict[str, tables.ParameterValue]:
    """Return the parameters whose names have another meaning for an earlier node, such as the viewer's port.

    In the section for all nodes of a shared file they belong to that earlier node, as arguments do.

    Returns:
        {parameter: default}
    """
    node_rows = [(name, rows[node]) for name, rows in arguments(tables.TABLES).items() if node in rows]
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


def _entries_of(node: str, path: str) -> Iterator[tuple[str, str, Any]]:
    """Yield section, name and value of every parameter in a file that is for a node of this name or for all nodes."""
    tree = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    return (one for one in _entries(tree, "") if one[0] in _WILDCARDS or one[0].rpartition("/")[2] == node)


def respawn_environment() -> dict[str, str]:
    """Return the environment that lets a respawned node continue with its parameters and state."""
    folder = tempfile.mkdtemp(prefix="uwb_mitigation_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {tables.RESPAWN_FOLDER: folder}


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
