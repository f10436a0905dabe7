"""Starts a driver and a mitigator, with the parameters of `params/` or files of your own.

Several boards: give each a namespace, such as `ros2 launch uwb_mitigation uwb.launch.py namespace:=board1`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of both nodes."),
    ]
    nodes = []
    for name in ("driver", "mitigator"):
        arguments.append(
            DeclareLaunchArgument(
                f"{name}_params",
                default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
                description=f"Parameter file of the {name}.",
            )
        )
        nodes.append(
            Node(
                package="uwb_mitigation",
                executable=name,
                name=name,
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration(f"{name}_params")],
                output="screen",
            )
        )
    return LaunchDescription(arguments + nodes)
