"""Starts a driver and a mitigator, with the parameters of `params/` or files of your own.

Several boards: give each a namespace, such as `ros2 launch uwb_mitigation uwb.launch.py namespace:=board1`.
`one_process:=true` runs both in one process, which takes less of the processor and sends no CIR unless
somebody subscribes to it.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of both nodes."),
        DeclareLaunchArgument("one_process", default_value="false", description="Run both in one process."),
    ]
    arguments += [
        DeclareLaunchArgument(
            f"{name}_params",
            default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
            description=f"Parameter file of the {name}.",
        )
        for name in ("driver", "mitigator")
    ]
    one_process = LaunchConfiguration("one_process")
    nodes = [
        Node(
            package="uwb_mitigation",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration(f"{name}_params")],
            output="screen",
            condition=UnlessCondition(one_process),
        )
        for name in ("driver", "mitigator")
    ]
    # Without a name: it would be given to both nodes of the process.
    pipeline = Node(
        package="uwb_mitigation",
        executable="pipeline",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("driver_params"), LaunchConfiguration("mitigator_params")],
        output="screen",
        condition=IfCondition(one_process),
    )
    return LaunchDescription([*arguments, *nodes, pipeline])
