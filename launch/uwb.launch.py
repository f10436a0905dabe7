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

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.support import launching

NODES = ("driver", "mitigator", "locator", "viewer")
PARAMETERS = launching.arguments(NODES)
OWN = {
    "params": ("", "Parameter file of all nodes; it overrides the files of single nodes."),
    "namespace": ("", "Namespace of the nodes."),
    "one_process": ("false", "Run driver and mitigator in one process: true or false."),
    "locate": ("false", "Start a locator too: true or false."),
    "viewer": ("false", "Start a viewer too, which serves a page: true or false."),
    "rviz": ("false", "Start RViz with the configuration of this package too: true or false."),
    "foxglove": ("false", "Start foxglove_bridge too, for Foxglove at ws://localhost:8765: true or false."),
    "use_sim_time": ("false", "Take the time from /clock: true or false."),
    "log_level": ("info", f"Log level of every node: {', '.join(launching.LOG_LEVELS)}."),
    "respawn": ("true", "Restart a node that crashes, but not after the end of a recording: true or false."),
}
FILES = tuple(f"{node}_params" for node in NODES)


@launching.report_errors
def nodes_of(context):
    launching.check_names(getattr(context, "argv", ()), {*PARAMETERS, *OWN, *FILES})
    texts = {name: LaunchConfiguration(name).perform(context) for name in (*PARAMETERS, *OWN, *FILES)}
    flag_names = ("one_process", "locate", "viewer", "rviz", "foxglove", "use_sim_time", "respawn")
    flag_names = {name: launching.choice(name, texts[name]) == "true" for name in flag_names}
    level = launching.choice("log_level", texts["log_level"], launching.LOG_LEVELS)
    files = {node: [texts[f"{node}_params"], *filter(None, [texts["params"]])] for node in NODES}
    file_values = {node: launching.from_files(node, *files[node]) for node in NODES}
    wanted = {"locator": flag_names["locate"], "viewer": flag_names["viewer"]}
    started = [node for node in wanted if wanted[node]]
    source = texts["source"] or file_values["driver"].get("source")
    if source:
        started = ["driver", "mitigator", *started]
    elif not (started or flag_names["rviz"] or flag_names["foxglove"]):
        raise ParameterError(
            "no source of ranges",
            valid="source:=serial port:=/dev/ttyACM0, source:=mcap path:=FILE, source:=decaranging path:=FILE, or "
            "source:=simulated for ranges that no radio measured",
        )
    values = launching.parameters(texts, started, NODES)
    if source:
        launching.check_driver(file_values["driver"] | values["driver"])
    for node in started if texts["params"] else ():
        own_values = {
            n: file_values[node].get(n, default)
            for n, default in launching.conflicting_parameters(node).items()
        }
        values[node] = own_values | values[node]
    common = {"use_sim_time": flag_names["use_sim_time"]}
    if flag_names["locate"] and "viewer" in values:
        # The locator publishes the anchors for the viewer.
        values["viewer"].pop("anchors", None)
    settings = {node: [*files[node], values[node], common] for node in started}
    if flag_names["one_process"] and source:
        # Without a node name, because it would apply to both nodes of the process.
        both = [texts["driver_params"], *files["mitigator"], values["driver"] | values["mitigator"], common]
        settings = {"pipeline": both} | {node: settings[node] for node in started if node in wanted}
    ends = source in ("mcap", "decaranging")
    kept = launching.kept_parameters()
    displays = []
    for name, package, arguments in (
        (
            "rviz",
            "rviz2",
            ["-d", PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "rviz", "uwb.rviz"])],
        ),
        ("foxglove", "foxglove_bridge", []),
    ):
        if flag_names[name]:
            launching.check_package(name, package)
            displays.append(
                Node(
                    package=package,
                    executable=package,
                    arguments=arguments,
                    parameters=[common],
                    output="screen",
                )
            )
    return displays + [
        Node(
            package="uwb_mitigation",
            executable=name,
            name=None if name == "pipeline" else name,
            namespace=texts["namespace"],
            parameters=parameters,
            output="screen",
            # The driver ends after the recording and must not be respawned.
            respawn=flag_names["respawn"] and not (name in ("driver", "pipeline") and ends),
            respawn_delay=0.5,
            additional_env=kept,
            ros_arguments=["--log-level", level],
        )
        for name, parameters in settings.items()
    ]


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("uwb_mitigation"), "params"])
    texts = {name: ("", launching.description(rows)) for name, rows in PARAMETERS.items()} | OWN
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=v, description=d) for n, (v, d) in texts.items()),
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
