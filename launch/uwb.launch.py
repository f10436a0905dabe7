"""Start driver and mitigator, and respawn them when they crash.

    ros2 launch uwb_mitigation uwb.launch.py source:=serial port:=/dev/ttyACM0
    ros2 launch uwb_mitigation uwb.launch.py source:=mcap path:=recording.mcap
    ros2 launch uwb_mitigation uwb.launch.py params:=robot.yaml             # sets the source

`locate:=true anchors:=anchors.yaml` also starts a locator, `viewer:=true` a page at http://localhost:5006, `rviz:=true`
RViz and `foxglove:=true` foxglove_bridge; without a source, only these start. Every parameter of these nodes is an
argument; `--show-args` lists them. For several boards give each a namespace, such as `namespace:=board1`, or see
`boards.launch.py`. `one_process:=true` runs driver and mitigator in one process, which needs less CPU and publishes
no CIR unless there is a subscriber.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from uwb_mitigation.nodes.support import launching

NODES = ("driver", "mitigator", "locator", "viewer")
PARAMETERS = launching.arguments(NODES)
FLAGS = {
    "one_process": ("false", "Run driver and mitigator in one process."),
    "locate": ("false", "Start a locator too."),
    "viewer": ("false", "Start a viewer too, which serves a page."),
    "rviz": ("false", "Start RViz with the configuration of this package too."),
    "foxglove": ("false", "Start foxglove_bridge too, for Foxglove at ws://localhost:8765."),
    "use_sim_time": ("false", "Take the time from /clock."),
    "respawn": ("true", "Restart a node that crashes, but not after the end of a recording."),
}
CHOICES = dict.fromkeys(FLAGS, launching.BOOLEANS) | {"log_level": launching.LOG_LEVELS}
ARGUMENTS = FLAGS | {
    "params": ("", "Parameter file of all nodes; it overrides the files of single nodes."),
    "namespace": ("", "Namespace of the nodes."),
    "log_level": ("info", "Log level of every node."),
}
FILES = tuple(f"{node}_params" for node in NODES)


def nodes_of(context):
    launching.check_names(getattr(context, "argv", ()), {*PARAMETERS, *ARGUMENTS, *FILES})
    texts = {name: LaunchConfiguration(name).perform(context) for name in (*PARAMETERS, *ARGUMENTS, *FILES)}
    flags = {name: texts[name].lower() == "true" for name in FLAGS}
    files = {node: [texts[f"{node}_params"], *filter(None, [texts["params"]])] for node in NODES}
    file_values = {node: launching.from_files(node, *files[node]) for node in NODES}
    source = texts["source"] or file_values["driver"].get("source")
    started = [node for node, flag in (("locator", "locate"), ("viewer", "viewer")) if flags[flag]]
    if not (source or started or flags["rviz"] or flags["foxglove"]):
        raise RuntimeError(
            "no source of ranges (source:=serial port:=/dev/ttyACM0, source:=mcap path:=FILE, source:=decaranging path:=FILE, "
            "or source:=simulated for ranges that no radio measured)"
        )
    radio_nodes = ["driver", "mitigator"] if source else []
    values = launching.parameters(texts, [*radio_nodes, *started], NODES)
    if texts["params"]:
        launching.separate_conflicts(values, file_values)
    if flags["locate"] and flags["viewer"]:
        # The locator publishes the anchors for the viewer.
        values["viewer"].pop("anchors", None)
    common = {"use_sim_time": flags["use_sim_time"]}
    parameters = {node: [*files[node], values[node], common] for node in values}
    if flags["one_process"] and source:
        # Without a node name, because it would apply to both nodes of the process.
        merged = values["driver"] | values["mitigator"]
        started_parameters = {node: parameters[node] for node in started}
        merged_files = [texts["driver_params"], *files["mitigator"]]
        parameters = {"pipeline": [*merged_files, merged, common]} | started_parameters
    environment = launching.respawn_environment()
    return displays(flags, common) + [
        Node(
            package="uwb_mitigation",
            executable=name,
            name=None if name == "pipeline" else name,
            namespace=texts["namespace"],
            parameters=parameters[name],
            output="screen",
            respawn=flags["respawn"],
            respawn_delay=0.1,
            on_exit=launching.on_exit,
            additional_env=environment,
            ros_arguments=["--log-level", texts["log_level"]],
        )
        for name in parameters
    ]


def displays(flags, common):
    """Return RViz and foxglove_bridge if they are requested."""
    layout = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "rviz", "uwb.rviz"])
    nodes = []
    for flag, package, arguments in (("rviz", "rviz2", ["-d", layout]), ("foxglove", "foxglove_bridge", [])):
        if flags[flag]:
            nodes.append(
                Node(
                    package=package,
                    executable=package,
                    arguments=arguments,
                    parameters=[common],
                    output="screen",
                )
            )
    return nodes


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    texts = {name: ("", launching.description(rows)) for name, rows in PARAMETERS.items()} | ARGUMENTS
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=v, description=d, choices=CHOICES.get(n))
                for n, (v, d) in texts.items()
            ),
            *(
                DeclareLaunchArgument(
                    f"{name}_params",
                    default_value=PathJoinSubstitution([params, f"{name}.yaml"]),
                    description=f"Parameter file of the {name}.",
                )
                for name in NODES
            ),
            OpaqueFunction(function=nodes_of),
        ]
    )
