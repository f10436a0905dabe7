"""The launch files, run against stand-ins for ROS's launch packages, which are not on PyPI."""

from __future__ import annotations

import runpy
import sys
from types import ModuleType, SimpleNamespace

import pytest
import yaml
from conftest import REPOSITORY

LAUNCH = REPOSITORY / "launch"


class Configuration:
    """A launch argument's value, looked up when it is performed."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch):
    """Runs a launch file's `generate_launch_description`; actions come back as plain records."""

    def record(kind: str):
        return lambda *values, **fields: SimpleNamespace(kind=kind, values=values, **fields)

    modules = {
        "launch": {"LaunchDescription": lambda entities: entities},
        "launch.actions": {
            "DeclareLaunchArgument": record("argument"),
            "OpaqueFunction": record("function"),
        },
        "launch.conditions": {
            "IfCondition": lambda value: ("if", value.name),
            "UnlessCondition": lambda value: ("unless", value.name),
        },
        "launch.substitutions": {
            "LaunchConfiguration": Configuration,
            "PathJoinSubstitution": lambda parts: parts,
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": record("node")},
        "launch_ros.substitutions": {"FindPackageShare": lambda package: f"share/{package}"},
    }
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    return lambda file: runpy.run_path(str(LAUNCH / file))["generate_launch_description"]()


def test_the_launch_file_starts_both_nodes_with_their_parameter_files(generate):
    entities = generate("uwb.launch.py")
    nodes = [entity for entity in entities if entity.kind == "node"]
    assert [(node.executable, node.condition) for node in nodes] == [
        ("driver", ("unless", "one_process")),
        ("mitigator", ("unless", "one_process")),
        ("pipeline", ("if", "one_process")),
    ]
    arguments = {entity.values[0]: entity for entity in entities if entity.kind == "argument"}
    assert set(arguments) == {"namespace", "one_process", "driver_params", "mitigator_params"}
    for name in ("driver", "mitigator"):
        assert arguments[f"{name}_params"].default_value == [
            ["share/uwb_mitigation", "params"],
            f"{name}.yaml",
        ]
        assert "/**" in yaml.safe_load((REPOSITORY / "params" / f"{name}.yaml").read_text())


def boards(generate, text: str, mode: str = "host"):
    (function,) = [entity for entity in generate("boards.launch.py") if entity.kind == "function"]
    return function.function({"boards": text, "mode": mode})


def test_every_board_gets_a_driver_and_a_mitigator_in_its_own_namespace(generate):
    nodes = boards(generate, "left=/dev/uwb/1A2B right=usb:2341:805a:3C4D", "device")
    assert [(node.namespace, node.executable) for node in nodes] == [
        ("left", "driver"),
        ("left", "mitigator"),
        ("right", "driver"),
        ("right", "mitigator"),
    ]
    assert nodes[2].parameters == [
        {
            "source": "serial",
            "port": "usb:2341:805a:3C4D",
            "mode": "device",
            "frame_id": "right_uwb_antenna",
        }
    ]


@pytest.mark.parametrize("text", ["/dev/ttyACM0", "left=", "1=/dev/ttyACM0", "=/dev/ttyACM0"])
def test_a_board_that_cannot_be_meant_is_refused(generate, text: str):
    with pytest.raises(ValueError, match="NAME=PORT"):
        boards(generate, text)
