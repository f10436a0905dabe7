"""The options of commands that estimate positions, in one place."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from uwb_mitigation.commands.support.bundles import ModelOption
from uwb_mitigation.commands.support.checks import OffsetsOption

if TYPE_CHECKING:
    from uwb_mitigation.positioning.track_settings import TrackSettings

AnchorsOption = Annotated[
    Path | None,
    typer.Option(
        "--anchors",
        metavar="FILE",
        help="YAML file of the anchors: `anchors: [{id: 1, x: 0.0, y: 0.0, z: 2.1}]`. Default: X.anchors.yaml next to the first "
        "BAG X.mcap.",
    ),
]


def track_settings(
    height: Annotated[
        float | None,
        typer.Option(help="Height of the tag's antenna in the anchors' frame, m, where it stays the same."),
    ] = None,
    height_sd: Annotated[float, typer.Option(help="Standard deviation of the height, m.")] = 0.1,
    height_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Topic of BAG with the measured height of the tag's antenna (Range above z = 0, Odometry or "
            "PoseWithCovarianceStamped). --height-sd is used if a message has no variance.",
        ),
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z", help="Where tags can be: the lower and the upper corner of a box, m."
        ),
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Odometry of the robot with the tag (nav_msgs/Odometry): also estimate its heading.",
        ),
    ] = None,
    imu: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="With --odometry: IMU of the robot (sensor_msgs/Imu); its yaw rate replaces that of the odometry.",
        ),
    ] = None,
    lever_arm: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="With --odometry: the antenna in the robot's frame, m. Default: from the transforms of the bag, otherwise 0.",
        ),
    ] = None,
    stamp_offset: Annotated[
        float,
        typer.Option(help="Time to add to the stamps of the ranges, s; -0.2 if they are late by 0.2 s."),
    ] = 0.0,
    acceleration: Annotated[
        float,
        typer.Option(
            help="Agility of the tags: 0.8 for robots, people and drones, less for slow vehicles. Square root of the spectral "
            "density of the acceleration, m/s^1.5."
        ),
    ] = 0.8,
    model: ModelOption = None,
    offsets: OffsetsOption = None,
) -> TrackSettings:
    """Return the settings that the options describe.

    Raises:
        ParameterError: an option is invalid, or two options exclude each other.
    """
    from uwb_mitigation.positioning.geometry import Area, parse_lever_arm
    from uwb_mitigation.positioning.track_settings import TrackSettings
    from uwb_mitigation.types.offsets import NO_OFFSETS

    motion = odometry, imu, parse_lever_arm(lever_arm), stamp_offset, acceleration
    return TrackSettings(
        height, height_sd, height_topic, Area.parse(area), *motion, model, offsets or NO_OFFSETS
    )


def with_settings(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of `track_settings` instead of its parameter `settings`; `names`: only these options."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        shared = _parameters(track_settings)
        shared = {name: shared[name] for name in names or shared}
        parameters = list[inspect.Parameter]()
        for name, parameter in _parameters(command).items():
            parameters += shared.values() if name == "settings" else [parameter]

        @functools.wraps(command)
        def wrapper(**values: Any) -> None:
            settings = track_settings(**{name: values.pop(name) for name in shared})
            command(settings=settings, **values)

        wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        wrapper.__annotations__ = {}
        return wrapper

    return decorate


def _parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the parameters with their types instead of the texts of these."""
    hints = get_type_hints(function, localns={"TrackSettings": object}, include_extras=True)
    parameters = inspect.signature(function).parameters
    return {name: parameter.replace(annotation=hints[name]) for name, parameter in parameters.items()}
