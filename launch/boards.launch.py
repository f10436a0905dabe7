"""Starts a driver and a mitigator for each of several boards, each pair in a namespace of its own.

    ros2 launch uwb_mitigation boards.launch.py boards:='left=/dev/uwb/1A2B right=usb:2341:805a:3C4D'

`left` then publishes on /left/uwb/range_raw and /left/uwb/range_corrected, in the frame `left_uwb_antenna`.
Each node comes back if it dies.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def nodes_of(context):
    def said(name):
        return LaunchConfiguration(name).perform(context)

    files = {name: said(f"{name}_params") for name in ("driver", "mitigator")}
    for path in files.values():
        if not Path(path).is_file():
            raise RuntimeError(f"parameter file {path}: no such file")
    common = {"use_sim_time": said("use_sim_time").lower() == "true"}
    model = {"model": said("model")} if said("model") else {}
    nodes = []
    for entry in said("boards").split():
        name, separator, port = entry.partition("=")
        if not (separator and name.isidentifier() and port):
            raise ValueError(f"boards: {entry!r} is not NAME=PORT, such as left=/dev/ttyACM0")
        board = {"source": "serial", "port": port, "mode": said("mode"), "frame_id": f"{name}_uwb_antenna"}
        for executable, own in (("driver", board), ("mitigator", model)):
            nodes.append(
                Node(
                    package="uwb_mitigation",
                    executable=executable,
                    name=executable,
                    namespace=name,
                    parameters=[files[executable], own, common],
                    output="screen",
                    respawn=said("respawn").lower() == "true",
                    respawn_delay=0.5,
                    ros_arguments=["--log-level", said("log_level")],
                )
            )
    return nodes


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    arguments = [
        ("mode", "host", "Who runs the model: host, device or both."),
        (
            "model",
            "",
            "Model bundle to correct with. Empty = as mitigator_params says, else universal.",
        ),
        ("use_sim_time", "false", "Take the time from /clock: true or false."),
        ("log_level", "info", "Of every node: debug, info, warn, error or fatal."),
        ("respawn", "true", "Start a node again when it dies: true or false."),
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("boards", description="NAME=PORT of each board, separated by spaces."),
            *(DeclareLaunchArgument(n, default_value=v, description=d) for n, v, d in arguments),
            *(
                DeclareLaunchArgument(
                    f"{name}_params",
                    default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
                    description=f"Parameter file of every {name}.",
                )
                for name in ("driver", "mitigator")
            ),
            OpaqueFunction(function=nodes_of),
        ]
    )
