"""Starts a driver and a mitigator, each of which comes back if it dies.

    ros2 launch uwb_mitigation uwb.launch.py source:=serial port:=/dev/ttyACM0
    ros2 launch uwb_mitigation uwb.launch.py source:=mcap path:=recording.mcap
    ros2 launch uwb_mitigation uwb.launch.py driver_params:=mine.yaml       # which names the source

`locate:=true anchors:=anchors.yaml` starts a locator too, `viewer:=true` a page at http://localhost:5006. Several boards: give each a namespace, such as `namespace:=board1`, or see `boards.launch.py`.
`one_process:=true` runs both in one process, which takes less of the processor and sends no CIR unless
somebody subscribes to it.
"""

from pathlib import Path

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FILED = ("driver", "mitigator", "locator", "viewer")
SOURCES = ("mcap", "decaranging", "simulated", "serial", "evb1000", "spi")


def parameters_in(path):
    """The parameters that a file sets, by name, whatever node it sets them for."""
    if not Path(path).is_file():
        raise RuntimeError(f"parameter file {path}: no such file")
    return dict(parameters_below(yaml.safe_load(Path(path).read_text(encoding="utf-8"))))


def parameters_below(tree):
    for name, branch in tree.items() if isinstance(tree, dict) else ():
        if name == "ros__parameters":
            yield from (branch or {}).items()
        else:
            yield from parameters_below(branch)


def nodes_of(context):
    def said(name):
        return LaunchConfiguration(name).perform(context)

    files = {name: said(f"{name}_params") for name in FILED}
    given = {name: parameters_in(path) for name, path in files.items()}
    if not (said("source") or given["driver"].get("source")):
        raise RuntimeError(
            "where do ranges come from? Say source:=serial port:=/dev/ttyACM0, source:=mcap path:=FILE, "
            "source:=decaranging path:=FILE, or source:=simulated for ranges that no radio measured"
        )
    # What is not said is left to the parameter files.
    driver = {name: said(name) for name in ("source", "port", "path") if said(name)}
    mitigator = {"model": said("model")} if said("model") else {}
    common = {"use_sim_time": said("use_sim_time").lower() == "true"}
    settings = {
        "driver": [files["driver"], driver, common],
        "mitigator": [files["mitigator"], mitigator, common],
    }
    if said("one_process").lower() == "true":
        # Without a name: it would be given to both nodes of the process.
        settings = {"pipeline": [files["driver"], files["mitigator"], driver | mitigator, common]}
    anchors = {"anchors": said("anchors")} if said("anchors") else {}
    locate = said("locate").lower() == "true"
    if locate:
        settings["locator"] = [files["locator"], anchors, common]
    if said("viewer").lower() == "true":
        # A locator tells the viewer where the anchors are.
        settings["viewer"] = [files["viewer"], {} if locate else anchors, common]
    ends = (driver.get("source") or given["driver"]["source"]) in ("mcap", "decaranging")
    return [
        Node(
            package="uwb_mitigation",
            executable=name,
            name=None if name == "pipeline" else name,
            namespace=said("namespace"),
            parameters=parameters,
            output="screen",
            # A recording ends its driver, which is then to stay away.
            respawn=said("respawn").lower() == "true" and not (name in ("driver", "pipeline") and ends),
            respawn_delay=0.5,
            ros_arguments=["--log-level", said("log_level")],
        )
        for name, parameters in settings.items()
    ]


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    arguments = [
        ("source", "", f"Where ranges come from: {', '.join(SOURCES)}. Empty = as driver_params says."),
        (
            "port",
            "",
            "Port of the board or radio: /dev/ttyACM0, or usb:VENDOR:PRODUCT[:SERIAL] (source:=serial, source:=evb1000); "
            "/dev/spidev0.0 (source:=spi).",
        ),
        ("path", "", "Recording to replay (source:=mcap, source:=decaranging)."),
        (
            "model",
            "",
            "Model bundle to correct with. Empty = as mitigator_params says, else universal.",
        ),
        ("namespace", "", "Namespace of the nodes."),
        ("one_process", "false", "Run driver and mitigator in one process: true or false."),
        ("locate", "false", "Start a locator too: true or false."),
        ("viewer", "false", "Start a viewer too, which serves a page: true or false."),
        (
            "anchors",
            "",
            "Anchors file of the locator, or of a viewer without one. Empty = as their files say.",
        ),
        ("use_sim_time", "false", "Take the time from /clock: true or false."),
        ("log_level", "info", "Of every node: debug, info, warn, error or fatal."),
        ("respawn", "true", "Start a node again when it dies, unless a recording has ended: true or false."),
    ]
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=v, description=d) for n, v, d in arguments),
            *(
                DeclareLaunchArgument(
                    f"{name}_params",
                    default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
                    description=f"Parameter file of the {name}.",
                )
                for name in FILED
            ),
            OpaqueFunction(function=nodes_of),
        ]
    )
