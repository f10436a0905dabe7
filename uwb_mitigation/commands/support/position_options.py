"""Options of commands that estimate positions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

AnchorsOption = Annotated[
    Path | None,
    typer.Option(
        "--anchors",
        metavar="FILE",
        help="YAML file of the anchors: `anchors: [{id: 1, x: 0.0, y: 0.0, z: 2.1}]`. Default: X.anchors.yaml next to the first "
        "BAG X.mcap.",
    ),
]
HeightOption = Annotated[
    float | None,
    typer.Option(help="Height of the tag's antenna in the anchors' frame, m, where it stays the same."),
]
HeightSdOption = Annotated[float, typer.Option("--height-sd", help="Standard deviation of the height, m.")]
HeightTopicOption = Annotated[
    str | None,
    typer.Option(
        "--height-topic",
        metavar="TOPIC",
        help="Topic of BAG with the measured height of the tag's antenna (Range above z = 0, Odometry or "
        "PoseWithCovarianceStamped). --height-sd is used if a message has no variance.",
    ),
]
AreaOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,X,Y,Z", help="Where tags can be: the lower and the upper corner of a box, m."
    ),
]
OffsetOption = Annotated[
    float,
    typer.Option(
        "--stamp-offset", help="Time to add to the stamps of the ranges, s; -0.2 if they are late by 0.2 s."
    ),
]
OdometryOption = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC",
        help="Odometry of the robot with the tag (nav_msgs/Odometry): also estimate its heading.",
    ),
]
ImuOption = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC",
        help="With --odometry: IMU of the robot (sensor_msgs/Imu); its yaw rate replaces that of the odometry.",
    ),
]
LeverArmOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="With --odometry: the antenna in the robot's frame, m. Default: from the transforms of the bag, otherwise 0.",
    ),
]
AccelerationOption = Annotated[
    float,
    typer.Option(
        help="Agility of the tags: 0.8 for robots, people and drones, less for slow vehicles. Square root of the spectral "
        "density of the acceleration, m/s^1.5."
    ),
]
