"""Starts a driver and a mitigator for each of several boards, each pair in a namespace of its own.

    ros2 launch uwb_mitigation boards.launch.py boards:='left=/dev/uwb/1A2B right=usb:2341:805a:3C4D'

`left` then publishes on /left/uwb/range_raw and /left/uwb/range_corrected, in the frame `left_uwb_antenna`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def nodes_of(context):
    mode = LaunchConfiguration("mode").perform(context)
    nodes = []
    for entry in LaunchConfiguration("boards").perform(context).split():
        name, separator, port = entry.partition("=")
        if not (separator and name.isidentifier() and port):
            raise ValueError(f"boards: {entry!r} is not NAME=PORT, such as left=/dev/ttyACM0")
        board = {"source": "serial", "port": port, "mode": mode, "frame_id": f"{name}_uwb_antenna"}
        for executable, parameters in (("driver", [board]), ("mitigator", [])):
            nodes.append(
                Node(
                    package="uwb_mitigation",
                    executable=executable,
                    name=executable,
                    namespace=name,
                    parameters=parameters,
                    output="screen",
                )
            )
    return nodes


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("boards", description="NAME=PORT of each board, separated by spaces."),
            DeclareLaunchArgument(
                "mode", default_value="host", description="Who runs the model: host, device or both."
            ),
            OpaqueFunction(function=nodes_of),
        ]
    )
