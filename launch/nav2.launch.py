"""Start Nav2 with the locator in place of AMCL: the locator publishes map -> odom.

    ros2 launch uwb_mitigation nav2.launch.py map:=map.yaml params_file:=nav2.yaml odometry:=/odom \
        source:=evb1000 port:=/dev/ttyACM0 anchors:=anchors.yaml

The coordinates of the anchors are those of the map. The robot's driver or a local EKF publishes odom -> base_link. Every
argument of `uwb.launch.py` is accepted.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

MAP_SERVER = "map_server"


def included(package, file, **arguments):
    path = PathJoinSubstitution([FindPackageShare(package), "launch", file])
    # A group of its own: defaults of one launch file must not reach the other, which has arguments of the same names.
    return GroupAction([IncludeLaunchDescription(path, launch_arguments=arguments.items())])


def generate_launch_description():
    use_sim_time = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Map of Nav2, a YAML file."),
            DeclareLaunchArgument("params_file", description="Parameters of Nav2, a YAML file."),
            DeclareLaunchArgument("odometry", default_value="/odom", description="Topic of the odometry."),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", description="Take the time from /clock."
            ),
            included(
                "uwb_mitigation",
                "uwb.launch.py",
                locate="true",
                publish_tf="true",
                odometry=LaunchConfiguration("odometry"),
            ),
            # Nav2's localization_launch.py would start AMCL too.
            Node(
                package="nav2_map_server",
                executable="map_server",
                name=MAP_SERVER,
                parameters=[use_sim_time, {"yaml_filename": LaunchConfiguration("map")}],
                output="screen",
            ),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                name="lifecycle_manager_map",
                parameters=[use_sim_time, {"autostart": True, "node_names": [MAP_SERVER]}],
                output="screen",
            ),
            included(
                "nav2_bringup",
                "navigation_launch.py",
                params_file=LaunchConfiguration("params_file"),
            ),
        ]
    )
