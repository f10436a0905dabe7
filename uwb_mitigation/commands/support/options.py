"""Options that commands share, and checks of files before a command starts its work."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer
from typer.core import TyperCommand

from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.positioning.track_settings import TrackSettings

ScalingName = Literal["preamble", "max"]
"""Values of `Scaling`, which takes long to import."""


class Command(TyperCommand):
    """A command whose docstring has the texts of its options in the section `Options`, {name of the parameter: text}.

    An option that is False by default has no counterpart `--no-...`.
    """

    def __init__(self, *arguments: Any, help: str | None = None, **details: Any) -> None:
        about, _, section = (help or "").partition("\n\nOptions:\n")
        super().__init__(*arguments, help=about, **details)
        entries = re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", section, re.MULTILINE)
        texts = {name: " ".join(text.split()) for name, text in entries}
        parameters: dict[str, Any] = {str(parameter.name): parameter for parameter in self.params}
        for name, text in texts.items():
            parameters[name].help = text
        for parameter in parameters.values():
            if parameter.default is False:
                parameter.secondary_opts.clear()


def option(text: str | None = None, *names: str, **details: Any) -> Any:
    """Return an option with its help text (None: that of the docstring); `details` are those of `typer.Option`."""
    return typer.Option(*names, help=text, **details)


def argument(metavar: str, text: str | None = None) -> Any:
    """Return an argument without a name, which stands for itself in the help."""
    return typer.Argument(metavar=metavar, help=text)


def output_option(metavar: str) -> Any:
    """Return the option `-o` for what a command writes."""
    return typer.Option("-o", "--output", metavar=metavar)


FileOption = Annotated[Path | None, option(metavar="FILE")]

OffsetsOption = Annotated[
    str | None,
    option(
        "Range offsets of the radios due to antenna delays: metres, or a file written by `uwb-mitigation offset`.",
        "--offsets",
        metavar="M|FILE",
    ),
]

ModelOption = Annotated[
    Path | None,
    option(
        "Bundle, or the name of a shipped one. Default: `auto`, the shipped model that fits the radio and the CIR.",
        metavar="FILE|NAME",
        show_default=False,
    ),
]

AnchorsOption = Annotated[
    Path | None,
    option(
        "YAML file of the anchors: `anchors: [{id: 1, x: 0.0, y: 0.0, z: 2.1}]`. Default: X.anchors.yaml next to the first "
        "BAG X.mcap.",
        "--anchors",
        metavar="FILE",
    ),
]


def check_replaceable(files: Iterable[Path], force: bool) -> None:
    """Raise a ParameterError if one of the files exists, unless `force` is set."""
    for file in files:
        if file.exists() and not force:
            raise ParameterError("exists already", where=file, valid="--force replaces it")


def check_output(output: Path, force: bool = True, suffix: str = ".onnx") -> None:
    """Check that a file with a suffix can be written to a path, with `force` also over an existing file.

    Raises:
        ParameterError: it cannot.
    """
    if (suffix and output.suffix != suffix) or output.is_dir() or not output.resolve().parent.is_dir():
        valid = f"a file {suffix} in an existing folder" if suffix else "a file in an existing folder"
        raise ParameterError("cannot be written", where=output, valid=valid)
    check_replaceable([output], force)


def _entry(default: Any, kind: Any, metavar: str | None, text: str) -> tuple[Any, Any]:
    """Return the default and the annotation of an option."""
    return default, Annotated[kind, option(text, metavar=metavar)]


OPTIONS: dict[str, tuple[Any, Any]] = {
    "height": _entry(None, float | None, None, "Height of the tag's antenna in the anchors' frame, m, where it stays the same."),
    "height_sd": _entry(0.1, float, None, "Standard deviation of the height, m."),
    "height_topic": _entry(None, str | None, "TOPIC", "Topic of BAG with the measured height of the tag's antenna (Range above "
                            "z = 0, Odometry or PoseWithCovarianceStamped). --height-sd is used if a message has no variance."),
    "area": _entry(None, str | None, "X,Y,Z,X,Y,Z", "Where tags can be: the lower and the upper corner of a box, m."),
    "odometry": _entry(None, str | None, "TOPIC", "Odometry of the robot with the tag (nav_msgs/Odometry): also estimate its "
                        "heading."),
    "imu": _entry(None, str | None, "TOPIC", "With --odometry: IMU of the robot (sensor_msgs/Imu); its yaw rate replaces that of "
                   "the odometry."),
    "lever_arm": _entry(None, str | None, "X,Y,Z", "With --odometry: the antenna in the robot's frame, m. Default: from the "
                         "transforms of the bag, otherwise 0."),
    "stamp_offset": _entry(0.0, float, None, "Time to add to the stamps of the ranges, s; -0.2 if they are late by 0.2 s."),
    "acceleration": _entry(0.8, float, None, "Agility of the tags: 0.8 for robots, people and drones, less for slow vehicles. "
                            "Square root of the spectral density of the acceleration, m/s^1.5."),
    "model": (None, ModelOption),
    "offsets": (None, OffsetsOption),
}  # fmt: skip
"""The default and the annotation of the options that `TrackSettings` has as fields."""


def track_settings(**values: Any) -> TrackSettings:
    """Return the settings that some of the `OPTIONS` describe.

    Raises:
        ParameterError: an option is invalid, or two options exclude each other.
    """
    from uwb_mitigation.positioning.geometry import Area, parse_lever_arm
    from uwb_mitigation.positioning.track_settings import TrackSettings

    parse: dict[str, Callable[[Any], Any]] = {"area": Area.parse, "lever_arm": parse_lever_arm}
    values |= {name: parse[name](values[name]) for name in parse.keys() & values.keys()}
    units = dict.fromkeys(("height", "height_sd", "lever_arm"), "_m") | {"stamp_offset": "_s"}
    return TrackSettings(**{name + units.get(name, ""): value for name, value in values.items()})


def with_settings(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the `OPTIONS` instead of its parameter `settings`; `names`: only these options."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, localns={"TrackSettings": object}, include_extras=True)
        options = names or tuple(OPTIONS)
        parameters = list[inspect.Parameter]()
        for name, parameter in inspect.signature(command).parameters.items():
            shared = {option: OPTIONS[option] for option in options}
            own = {name: (parameter.default, hints[name])}
            parameters += [
                parameter.replace(name=option, default=default, annotation=annotation)
                for option, (default, annotation) in (shared if name == "settings" else own).items()
            ]

        @functools.wraps(command)
        def wrapper(**values: Any) -> None:
            settings = track_settings(**{name: values.pop(name) for name in options})
            command(settings=settings, **values)

        wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        wrapper.__annotations__ = {}
        return wrapper

    return decorate
