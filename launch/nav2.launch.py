"""Start Nav2 with the locator in place of AMCL: the locator publishes map -> odom.

    ros2 launch uwb_mitigation nav2.launch.py map:=map.yaml params_file:=nav2.yaml odometry:=/odom \
        source:=evb1000 port:=/dev/ttyACM0 anchors:=anchors.yaml

The coordinates of the anchors are those of the map. The robot's driver or a local EKF publishes odom -> base_link. Every
argument of `uwb.launch.py` is accepted. With `namespace:=robot1` all nodes and relative topics are in /robot1, also /tf and
/tf_static, as in Nav2's own launch files.
"""

import re
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

MAP_SERVER = "map_server"
TF = [("/tf", "tf"), ("/tf_static", "tf_static")]
NAMESPACE = LaunchConfiguration("namespace")


def navigation_pushes_namespace():
    """Return whether the installed Nav2 puts its nodes into the namespace: since Lyrical, but not in Jazzy and Kilted."""
    file = Path(get_package_share_directory("nav2_bringup"), "launch", "navigation_launch.py")
    text = file.read_text(encoding="utf-8")
    return re.search(r"^[^#\n]*\bPushR(os|OS)Namespace\(", text, re.MULTILINE) is not None


def included(package, file, *actions, **arguments):
    path = PathJoinSubstitution([FindPackageShare(package), "launch", file])
    # A group of its own: defaults of one launch file must not reach the other, which has arguments of the same names.
    return GroupAction([*actions, IncludeLaunchDescription(path, launch_arguments=arguments.items())])


def generate_launch_description():
    use_sim_time = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Map of Nav2, a YAML file."),
            DeclareLaunchArgument("params_file", description="Parameters of Nav2, a YAML file."),
            DeclareLaunchArgument("odometry", default_value="odom", description="Topic of the odometry."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the robot."),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", description="Take the time from /clock."
            ),
            included(
                "uwb_mitigation",
                "uwb.launch.py",
                locate="true",
                publish_tf="true",
                odometry=LaunchConfiguration("odometry"),
                namespace=NAMESPACE,
            ),
            # Nav2's localization_launch.py would start AMCL too.
            Node(
                package="nav2_map_server",
                executable="map_server",
                name=MAP_SERVER,
                namespace=NAMESPACE,
                remappings=TF,
                parameters=[use_sim_time, {"yaml_filename": LaunchConfiguration("map")}],
                output="screen",
            ),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                name="lifecycle_manager_map",
                namespace=NAMESPACE,
                parameters=[use_sim_time, {"autostart": True, "node_names": [MAP_SERVER]}],
                output="screen",
            ),
            included(
                "nav2_bringup",
                "navigation_launch.py",
                # Every Nav2 puts its parameters into the namespace.
                *([] if navigation_pushes_namespace() else [PushRosNamespace(NAMESPACE)]),
                namespace=NAMESPACE,
                params_file=LaunchConfiguration("params_file"),
            ),
        ]
    )
