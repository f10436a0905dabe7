"""The launch files, with replacements for the launch packages of ROS, which are not on PyPI."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from conftest import REPOSITORY

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.support import launching
from uwb_mitigation.nodes.support.parameter_tables import CRASHED, DAMAGED, REFUSED, TABLES

LAUNCH = REPOSITORY / "launch"


class Configuration:
    """Value of a launch argument, evaluated by `perform`."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Runs a launch file's `generate_launch_description`; actions come back as plain records. Nav2 is in `tmp_path`."""
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "navigation_launch.py").touch()

    def record(kind: str):
        return lambda *values, **fields: SimpleNamespace(kind=kind, values=values, **fields)

    modules = {
        "ament_index_python.packages": {"get_package_share_directory": lambda package: tmp_path},
        "launch": {"LaunchDescription": lambda entities: entities},
        "launch.actions": {
            "DeclareLaunchArgument": record("argument"),
            "EmitEvent": record("event"),
            "GroupAction": record("group"),
            "IncludeLaunchDescription": record("include"),
            "OpaqueFunction": record("function"),
            "Shutdown": record("shutdown"),
        },
        "launch.events": {"matches_action": lambda action: action},
        "launch.events.process": {"ShutdownProcess": record("shutdown of a process")},
        "launch.substitutions": {
            "LaunchConfiguration": Configuration,
            "PathJoinSubstitution": lambda segments: segments,
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": record("node"), "PushRosNamespace": record("push")},
        "launch_ros.substitutions": {"FindPackageShare": lambda package: f"share/{package}"},
    }
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    return lambda file: runpy.run_path(str(LAUNCH / file))["generate_launch_description"]()


def described(generate, file: str) -> tuple[dict, object]:
    """Return the arguments that a launch file declares, and the function that creates its nodes."""
    entities = generate(file)
    (function,) = [entity for entity in entities if entity.kind == "function"]
    arguments = {entity.values[0]: entity for entity in entities if entity.kind == "argument"}
    assert all(argument.description.endswith(".") for argument in arguments.values()), "for --show-args"
    return arguments, function.function


def launch(generate, file: str, **overrides: str) -> list:
    """Return the nodes that a launch file starts with the given arguments."""
    arguments, nodes_of = described(generate, file)
    assert set(overrides) <= set(arguments)
    return nodes_of(values_of(arguments) | overrides)


def values_of(arguments: dict) -> dict[str, str]:
    """Return the default of each argument."""
    values = {name: str(REPOSITORY / "params" / f"{name.removesuffix('_params')}.yaml") for name in arguments}
    defaults = {name: getattr(argument, "default_value", None) for name, argument in arguments.items()}
    return values | {name: default for name, default in defaults.items() if isinstance(default, str)}


def settings(node) -> dict[str, object]:
    """Return the parameters of a node in addition to its file; launch_ros keeps the types of Python."""
    groups = [group for group in node.parameters if isinstance(group, dict)]
    return {name: value for group in groups for name, value in group.items()}


def test_both_nodes_start_with_their_arguments_and_are_respawned(generate):
    overrides = {"source": "serial", "port": "/dev/ttyACM0", "model": "mine.onnx", "namespace": "left"}
    driver, mitigator = launch(generate, "uwb.launch.py", **overrides, log_level="debug", use_sim_time="True")
    assert (driver.executable, mitigator.executable) == ("driver", "mitigator")
    assert settings(driver) == {"source": "serial", "port": "/dev/ttyACM0", "use_sim_time": True}
    assert settings(mitigator) == {"model": "mine.onnx", "use_sim_time": True}
    for node in (driver, mitigator):
        assert (node.namespace, node.respawn, node.ros_arguments) == ("left", True, ["--log-level", "debug"])
        assert node.parameters[0] == str(REPOSITORY / "params" / f"{node.executable}.yaml")
    assert not any(node.respawn for node in launch(generate, "uwb.launch.py", **overrides, respawn="false"))


def test_one_process_and_the_viewer_get_their_arguments(generate):
    overrides = {"source": "serial", "port": "/dev/x", "model": "m.onnx"}
    given = overrides | {"anchors": "a.yaml", "viewer": "true", "one_process": "true"}
    pipeline, viewer = launch(generate, "uwb.launch.py", **given)
    assert (pipeline.executable, pipeline.name, pipeline.respawn) == ("pipeline", None, True)
    assert settings(pipeline) == overrides | {"use_sim_time": False}
    assert [Path(file).name for file in pipeline.parameters[:2]] == ["driver.yaml", "mitigator.yaml"]
    assert (viewer.executable, viewer.name, viewer.respawn) == ("viewer", "viewer", True)
    assert settings(viewer) == {"anchors": "a.yaml", "use_sim_time": False}


def test_displays_and_the_locator_start_without_a_source(generate):
    displays = {"rviz": "true", "foxglove": "True", "viewer": "true"}
    nodes = launch(generate, "uwb.launch.py", locate="true", anchors="anchors.yaml", **displays)
    rviz, _, locator, viewer = nodes
    assert [node.executable for node in nodes] == ["rviz2", "foxglove_bridge", "locator", "viewer"]
    assert rviz.arguments == ["-d", ["share/uwb_mitigation", "rviz", "uwb.rviz"]]
    assert settings(locator)["anchors"] == "anchors.yaml"
    assert settings(viewer) == {"use_sim_time": False}, "the locator publishes them"


@pytest.mark.parametrize("file", ["uwb.launch.py", "boards.launch.py"])
@pytest.mark.parametrize(
    ("code", "kinds"), [(0, ["event"]), (DAMAGED, ["event"]), (REFUSED, []), (CRASHED, []), (-9, [])]
)
def test_only_a_crashed_node_is_respawned(generate, file: str, code: int, kinds: list[str]):
    """The package launch handles on_exit during respawn_delay, before it respawns a node."""
    source = {"source": "mcap"} if file == "uwb.launch.py" else {"boards": "left=/dev/x"}
    node, *_ = launch(generate, file, **source)
    event = SimpleNamespace(returncode=code, action=node, process_name="driver-1")
    if code == REFUSED:
        with pytest.raises(RuntimeError, match="driver-1 refused"):
            node.on_exit(event, None)
        return
    actions = node.on_exit(event, None)
    assert [action.kind for action in actions] == kinds
    if kinds:
        # A recording is not replayed again; the other nodes continue.
        event = actions[0].event
        assert (event.kind, event.process_matcher) == ("shutdown of a process", node)


def test_every_parameter_is_an_argument_and_reaches_its_node_with_its_type(generate):
    overrides = {"source": "serial", "port": "usb:2341:805a", "locate": "true", "viewer": "true"}
    arguments, _ = described(generate, "uwb.launch.py")
    examples = {"frame_id": "1234", "radio.address": "34", "radio.anchors": "'0xdeca010203040506'", "seed": "maybe",
                "offsets": "0.25", "level": "true", "height": "1e-1", "publish_tf": "True", "loop": "maybe", "start_delay": "maybe",
                "viewer_port": "8080", "locator_rate": "20", "rate": "2", "radio.pan": "7", "area": "0,0,0,9,9,3"}  # fmt: skip
    assert set(examples) <= set(arguments)
    for node, table in TABLES.items():
        for row in table:
            assert {row.name, f"{node}_{row.name}"} & set(arguments), row
    started = launch(generate, "uwb.launch.py", **overrides, **examples)
    nodes = {node.executable: settings(node) for node in started}
    assert nodes["driver"]["frame_id"] == "1234", "a text stays a string"
    radio = {"radio.address": "34", "radio.anchors": "0xdeca010203040506", "radio.pan": 7, "offsets": "0.25"}
    radio |= {"rate": 2.0, "port": "usb:2341:805a"}
    expected = {
        # The node refuses texts of another type.
        "driver": radio | dict.fromkeys(("seed", "loop", "start_delay"), "maybe"),
        "mitigator": {"offsets": "0.25"},
        "locator": {"level": True, "height": 0.1, "publish_tf": True, "rate": 20.0, "area": "0,0,0,9,9,3"},
        "viewer": {"port": 8080},
    }
    for node, values in expected.items():
        assert {name: nodes[node][name] for name in values} == values
        assert all(type(nodes[node][name]) is type(value) for name, value in values.items())
    assert not {"level", "rate"} & set(nodes["mitigator"])


@pytest.mark.parametrize("file", ["uwb.launch.py", "boards.launch.py"])
def test_flags_and_log_level_have_choices_which_launch_checks(generate, file: str):
    arguments, _ = described(generate, file)
    choices = {name: getattr(argument, "choices", None) for name, argument in arguments.items()}
    flags = {"one_process", "locate", "viewer", "rviz", "foxglove", "use_sim_time", "respawn"}
    assert {name for name, values in choices.items() if values == launching.BOOLEANS} == flags & set(
        arguments
    )
    assert choices["log_level"] == launching.LOG_LEVELS


@pytest.mark.parametrize(
    ("file", "given", "error", "message"),
    [
        ("uwb", {}, RuntimeError, r"source:=serial.*source:=simulated"),
        ("uwb", {"source": "simulated", "height": "1.0"}, ParameterError, r"height:=1.0.*locate:=true"),
        ("uwb", {"source": "serial", "params": "absent.yaml"}, FileNotFoundError, r"absent\.yaml"),
        ("boards", {"boards": "left=/dev/x", "params": "absent.yaml"}, FileNotFoundError, r"absent\.yaml"),
        *(
            ("boards", {"boards": text}, ValueError, "NAME=PORT")
            for text in ("/dev/ttyACM0", "left=", "1=/dev/x", "=/dev/x")
        ),
    ],
)
def test_arguments_that_cannot_be_used_stop_the_launch(
    generate, file: str, given: dict[str, str], error: type[Exception], message: str
):
    with pytest.raises(error, match=message):
        launch(generate, f"{file}.launch.py", **given)


class Context(dict):
    """The launch context: values of arguments, and the command line after the launch file."""

    argv = ("log_level:=info", "hieght:=0.4")


@pytest.mark.parametrize("file", ["uwb.launch.py", "boards.launch.py"])
def test_unknown_argument_stops_the_launch_except_for_those_of_an_including_file(
    generate, file: str, monkeypatch: pytest.MonkeyPatch
):
    arguments, nodes_of = described(generate, file)
    context = Context(values_of(arguments) | {"source": "simulated", "boards": "left=/dev/x"})
    with pytest.raises(ParameterError, match="hieght"):
        nodes_of(context)
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "robot_bringup", "robot.launch.xml", *Context.argv])
    assert nodes_of(context)


def test_one_file_configures_all_nodes(generate, tmp_path: Path):
    robot = tmp_path / "robot.yaml"
    robot.write_text(
        "/**:\n  ros__parameters: {source: serial, port: /dev/x, offsets: 0.2, use_sim_time: true}\n"
        "driver: {ros__parameters: {radio: {channel: 2}, rate: 3}}\n"
        "/left/locator: {ros__parameters: {anchors: a.yaml}}\n"
        "controller_server: {ros__parameters: {frequency: 20.0}}\n"
    )
    nodes = launch(generate, "uwb.launch.py", params=str(robot), locate="true", viewer="true")
    assert [node.executable for node in nodes] == ["driver", "mitigator", "locator", "viewer"]
    assert all(node.parameters[1] == str(robot) for node in nodes)
    # `port` for all nodes is the driver's.
    assert "port" not in settings(nodes[0])
    assert settings(nodes[3])["port"] == 5006
    (pipeline,) = launch(generate, "uwb.launch.py", params=str(robot), one_process="true")
    assert pipeline.parameters[2] == str(robot)
    # The file of the driver sets its source, too.
    driver, _ = launch(generate, "uwb.launch.py", driver_params=str(robot))
    assert settings(driver) == {"use_sim_time": False}


def test_every_board_gets_a_driver_and_a_mitigator_in_its_own_namespace(generate):
    boards = "left=/dev/uwb/1A2B right=usb:2341:805a:3C4D"
    nodes = launch(generate, "boards.launch.py", boards=boards, mode="device")
    expected = [(name, node) for name in ("left", "right") for node in ("driver", "mitigator")]
    assert [(node.namespace, node.executable) for node in nodes] == expected
    given = {"source": "serial", "port": "usb:2341:805a:3C4D", "mode": "device", "use_sim_time": False}
    assert settings(nodes[2]) == given | {"frame_id": "right_uwb_antenna"}
    assert all(node.respawn for node in nodes)


@pytest.mark.parametrize(
    ("navigation_launch", "pushes"),
    [
        ("load_nodes = GroupAction([Node(package='nav2_controller')])  # PushROSNamespace(namespace)", 1),
        ("load_nodes = GroupAction([\n    PushROSNamespace(namespace=namespace),\n    Node()])", 0),
        ("load_nodes = GroupAction([\n    PushRosNamespace(namespace=namespace),\n    Node()])", 0),
    ],
    ids=["Jazzy", "Lyrical", "another spelling"],
)
def test_nav2_gets_the_transform_of_the_locator_in_its_namespace_and_no_amcl(
    generate, navigation_launch: str, pushes: int, tmp_path: Path
):
    (tmp_path / "launch" / "navigation_launch.py").write_text(navigation_launch)
    entities = generate("nav2.launch.py")
    groups = [entity.values[0] for entity in entities if entity.kind == "group"]
    context = {"odometry": "odom", "namespace": "robot1", "params_file": "nav2.yaml"}
    included = {group[-1].values[0][0]: group for group in groups}
    assert {package_share: group[-1].values[0][1:] for package_share, group in included.items()} == {
        "share/uwb_mitigation": ["launch", "uwb.launch.py"],
        "share/nav2_bringup": ["launch", "navigation_launch.py"],
    }
    *pushed, navigation = included["share/nav2_bringup"]
    performed = [(action.kind, action.values[0].perform(context)) for action in pushed]
    assert performed == [("push", "robot1")] * pushes
    overrides = {name: value.perform(context) for name, value in navigation.launch_arguments}
    assert overrides == {"namespace": "robot1", "params_file": "nav2.yaml"}
    nodes = [entity for entity in entities if entity.kind == "node"]
    assert [node.executable for node in nodes] == ["map_server", "lifecycle_manager"]
    assert {node.namespace.perform(context) for node in nodes} == {"robot1"}
    assert nodes[0].remappings == [("/tf", "tf"), ("/tf_static", "tf_static")]
    assert nodes[1].parameters[1]["node_names"] == [nodes[0].name]
    # The arguments for the locator, as uwb.launch.py understands them.
    (group,) = included["share/uwb_mitigation"]
    given = dict(group.launch_arguments)
    overrides = {n: value if isinstance(value, str) else value.perform(context) for n, value in given.items()}
    (locator,) = launch(generate, "uwb.launch.py", **overrides, anchors="a.yaml")
    assert locator.namespace == "robot1"
    given = {"publish_tf": True, "odometry": "odom", "anchors": "a.yaml", "use_sim_time": False}
    assert settings(locator) == given
