"""Start a driver and a mitigator for each of several boards, each pair in its own namespace.

    ros2 launch uwb_mitigation boards.launch.py boards:='left=/dev/uwb/1A2B right=usb:2341:805a:3C4D'

`left` then publishes on /left/uwb/range_raw and /left/uwb/range_corrected, in the frame `left_uwb_antenna`.
A node that crashes is respawned. Every other parameter of driver and mitigator is an argument, for all boards.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from uwb_mitigation.nodes.support import launching

NODES = ("driver", "mitigator")
PARAMETERS = {
    name: rows
    for name, rows in launching.arguments(NODES).items()
    if name not in ("source", "port", "path", "frame_id")
}
ARGUMENTS = {
    "params": ("", "Parameter file of all nodes; it overrides the files of single nodes."),
    "use_sim_time": ("false", "Take the time from /clock."),
    "log_level": ("info", "Log level of every node."),
    "respawn": ("true", "Restart a node that crashes."),
}
CHOICES = {
    "use_sim_time": launching.BOOLEANS,
    "log_level": launching.LOG_LEVELS,
    "respawn": launching.BOOLEANS,
}
FILES = tuple(f"{node}_params" for node in NODES)


def nodes_of(context):
    names = (*PARAMETERS, *ARGUMENTS, *FILES, "boards")
    launching.check_names(getattr(context, "argv", ()), names)
    texts = {name: LaunchConfiguration(name).perform(context) for name in names}
    files = {node: [texts[f"{node}_params"], *filter(None, [texts["params"]])] for node in NODES}
    for node in NODES:
        launching.from_files(node, *files[node])  # launch_ros only warns of a missing file
    values = launching.parameters({name: texts[name] for name in PARAMETERS}, NODES, NODES)
    common = {"use_sim_time": texts["use_sim_time"].lower() == "true"}
    environment = launching.respawn_environment()
    nodes = []
    for entry in texts["boards"].split():
        name, separator, port = entry.partition("=")
        if not (separator and name.isidentifier() and port):
            raise ValueError(f"boards: {entry!r} is not NAME=PORT, such as left=/dev/ttyACM0")
        board = {"source": "serial", "port": port, "frame_id": f"{name}_uwb_antenna"}
        for node in NODES:
            node_values = values[node] | board if node == "driver" else values[node]
            nodes.append(
                Node(
                    package="uwb_mitigation",
                    executable=node,
                    name=node,
                    namespace=name,
                    parameters=[*files[node], node_values, common],
                    output="screen",
                    respawn=texts["respawn"].lower() == "true",
                    respawn_delay=0.1,
                    on_exit=launching.on_exit,
                    additional_env=environment,
                    ros_arguments=["--log-level", texts["log_level"]],
                )
            )
    return nodes


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    texts = {name: ("", launching.description(rows)) for name, rows in PARAMETERS.items()} | ARGUMENTS
    return LaunchDescription(
        [
            DeclareLaunchArgument("boards", description="NAME=PORT of each board, separated by spaces."),
            *(
                DeclareLaunchArgument(n, default_value=v, description=d, choices=CHOICES.get(n))
                for n, (v, d) in texts.items()
            ),
            *(
                DeclareLaunchArgument(
                    f"{name}_params",
                    default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
                    description=f"Parameter file of every {name}.",
                )
                for name in NODES
            ),
            OpaqueFunction(function=nodes_of),
        ]
    )
