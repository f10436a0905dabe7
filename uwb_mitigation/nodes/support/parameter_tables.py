"""The parameter tables of the nodes: name, type, default, range and description. No ROS here.

The declarations, `--help`, launch arguments, files in `params/` and the parameter reference are generated from them.
generate_parameter_library is not used: it generates code at build time and is not on PyPI.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from uwb_mitigation.errors import ParameterError, did_you_mean

ParameterValue = bool | int | float | str

_TYPE_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of a table.

    Attributes:
        name, default: as declared; the default's type is the parameter's type.
        description: one sentence for the user.
        unit: unit of a number; empty if it has no unit.
        or_number: whether a string parameter also accepts a number.
        or_array: whether it also accepts an array of whole numbers or strings.
        low, high: inclusive range of a number.
        choices: valid values of a string; empty: any.
        filed: whether the parameter file contains it; otherwise the user must set it.
        live: whether it may be set while the node runs; otherwise it is read-only after start-up.
    """

    name: str
    default: ParameterValue
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    filed: bool = True
    unit: str = ""
    or_number: bool = False
    or_array: bool = False

    @property
    def valid(self) -> str:
        """Return the range of valid values as text."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.low is not None and self.high is not None:
            low, high = (f"{bound:.10g}" for bound in (self.low, self.high))
            return f"{_TYPE_NAMES[type(self.default)]}, {low} to {high} {self.unit}".rstrip()
        if self.or_array:
            return "a number, a text, or an array"
        return "a number or a text" if self.or_number else _TYPE_NAMES[type(self.default)]

    @property
    def default_text(self) -> str:
        """Return the default in YAML syntax."""
        if isinstance(self.default, bool):
            return str(self.default).lower()
        return str(self.default) or "''"

    def check(self, value: Any) -> None:
        """Raise ParameterError unless `value` has the right type and is in the range."""
        numeric = isinstance(self.default, float) and type(value) is int
        numeric |= self.or_number and type(value) in (int, float)
        if self.or_array and not isinstance(value, str | float | bool) and isinstance(value, Iterable):
            numeric = all(type(item) in (int, str) for item in value)
        if type(value) is not type(self.default) and not numeric:
            raise ParameterError(f"parameter {self.name} = {value!r}", valid=self.valid)
        if self.choices:
            inside = value in self.choices
        else:
            inside = self.low is None or self.high is None or self.low <= value <= self.high
        if not inside:
            suggestion = did_you_mean(value, self.choices)
            raise ParameterError(
                f"parameter {self.name} = {value!r}", valid=self.valid, suggestion=suggestion
            )


_SENSOR_RANGES = Parameter(
    "sensor_ranges", False, "Publish corrected ranges as sensor_msgs/Range as well, on uwb/range_corrected/anchor_ID; "
    "an invalid range is +Inf. The driver publishes ranges that the board has corrected.",
)  # fmt: skip


def _radio(name: str, default: ParameterValue, description: str, **options: Any) -> Parameter:
    sources = "serial, evb1000, spi, uci" if name in _UCI else "serial, evb1000, spi"
    return Parameter(f"radio.{name}", default, f"{description} ({sources}).", live=True, **options)


_UCI = ("role", "address", "channel", "preamble_code", "window", "anchors", "rate", "report")
"""Parameters of radios that UCI boards use, too."""

RADIO = (
    _radio("role", "tag", "Role of the first radio: a tag ranges with anchors, an anchor answers",
           choices=("tag", "anchor")),
    _radio("address", "", "Address, such as 34 or '0xdeca010203040506'; empty: address of the chip. With uci, a number below "
           "65535; empty: 1 for a tag, 2 for an anchor; each additional port has the next number", or_number=True),
    _radio("pan", 0x5542, "PAN id; frames of other networks are rejected", low=0, high=0xFFFE),
    _radio("channel", 0, "UWB channel: 1 to 5, or 7; 5 or 9 with uci. 0: 5, or 9 with uci", low=0, high=9),
    _radio("prf", 64, "Pulse repetition frequency: 16 or 64", low=16, high=64, unit="MHz"),
    _radio("preamble", 128, "Preamble: 64, 128, 256, 512, 1024, 1536, 2048 or 4096 symbols; a longer one increases range "
           "and air time", low=64, high=4096, unit="symbols"),
    _radio("preamble_code", 0, "Preamble code; 0: first code of the standard for channel and PRF, or 10 with uci", low=0, high=24),
    _radio("data_rate", 6800, "Data rate: 110, 850 or 6800", low=110, high=6800, unit="kbit/s"),
    _radio("decawave_sfd", False, "Use Decawave's start-of-frame delimiter instead of the standard one"),
    _radio("tx_power", 0, "Register TX_POWER in smart-power format (lowest octet: frames of any length; below 6.8 Mbit/s "
           "it is used for all). 0: value from OTP, or from the manual", low=0, high=0xFFFFFFFF),
    _radio("antenna_delay", 0, "Total TX + RX antenna delay. 0: value from OTP, or 2 x 16436",
           low=0, high=0x1FFFE, unit="ticks"),
    _radio("window", 157, "Number of CIR samples of each range; 1016: all, or 255 with uci", low=0, high=1016),
    _radio("anchors", "", "Addresses that a tag polls in turn, separated by commas; empty: all anchors that answer; with "
           "uci, those at the other ports", or_number=True, or_array=True),
    _radio("rate", 0.0, "Maximum rate of exchanges; 0: as fast as possible; with uci, 55 for a "
           "window of 16 and 11 for 157. All uci boards need the same rate", low=0.0, high=1000.0, unit="Hz"),
    _radio("report", False, "An anchor also publishes its ranges"),
    _radio("bias_correction", False, "Correct the range bias over received power (APS011); the models were "
           "trained without this correction"),
)  # fmt: skip

DRIVER = (
    Parameter("source", "simulated", "Source of the measurements.",
              choices=("mcap", "decaranging", "simulated", "serial", "evb1000", "spi", "uci", "lines", "pans", "topic"), filed=False),
    Parameter("path", "", "Recording to replay: a bag (mcap), a log or a folder of logs (decaranging), or a capture (uci, lines, pans)."),
    Parameter("topic", "", "Topic of the ranges inside the bag, empty: /uwb/range_raw (mcap); or topics instead of those "
              "of the mapping, separated by commas (topic)."),
    Parameter("robot_topics", "/odom,/imu,/tf,/tf_static", "Topics of a robot that are replayed with the ranges of a bag, if "
              "it contains them, separated by commas: Odometry, Imu and TFMessage. Transforms from map are left out, because "
              "a locator publishes them. Empty: none (mcap)."),
    Parameter("map", "", "Mapping file for messages of other software or for lines of text, or name of a shipped mapping "
              "(topic, lines). With pans, empty: dwm1001_pans."),
    Parameter("cir", "final", "Frame whose CIR belongs to a range (decaranging).",
              choices=("final", "poll")),
    Parameter("seed", 1, "Seed of the simulated measurements.", low=0, high=2**31 - 1),
    Parameter("count", 0, "Number of simulated measurements; 0: endless.", low=0, high=2**31 - 1),
    Parameter("simulated_rate", 40.0, "Rate of simulated exchanges, over all pairs.",
              low=0.1, high=10_000.0, unit="Hz"),
    Parameter("rate", 1.0, "Speed of a replay relative to the recording.",
              low=0.001, high=10_000.0, live=True),
    Parameter("paused", False, "Pause the replay.", live=True),
    Parameter("seek_to", 0.0, "Start position of a replay in the recording. If it is set during the replay, "
              "the replay continues from there.", low=0.0, high=1e9, live=True, unit="s"),
    Parameter("loop", False, "Restart a replay at its end; otherwise the node exits."),
    Parameter("longest_pause", 5.0, "Longer pauses of a recording are shortened to this (recorded time).",
              low=0.0, high=1e6, unit="s"),
    Parameter("publish_clock", False, "Publish the time of the recording on /clock, and use it for stamps. "
              "Run the other nodes with use_sim_time."),
    Parameter("wait_for_subscribers", 1, "Number of subscribers that a replay waits for.",
              low=0, high=1000),
    Parameter("longest_wait", 10.0, "Timeout of this wait; then the replay starts.",
              low=0.0, high=3600.0, unit="s"),
    Parameter("start_delay", -1.0, "Pause before the first range of a replay, after the subscribers have connected, so that the "
              "other nodes can connect. -1: no pause if wait_for_subscribers is two or more and all have connected, "
              "otherwise 3 s.",
              low=-1.0, high=3600.0, unit="s"),
    Parameter("port", "", "Serial port of the board: a path such as /dev/ttyACM0, or "
              "usb:VENDOR:PRODUCT[:SERIAL] with hexadecimal ids for any USB port (serial, evb1000, uci, lines, pans); udp:PORT or "
              "udp:ADDRESS:PORT to receive datagrams (lines); or /dev/spidev0.0 (spi). Several radios are separated by "
              "commas: the first has radio.role, the others are anchors; with lines and pans, each is a tag."),
    Parameter("baud", 0, "Baud rate of a serial line; native USB ignores it. 0: 921600 (serial), or that of the mapping (lines, "
              "pans).", low=0, high=12_000_000, unit="bit/s"),
    Parameter("dtr", True, "Level of DTR: boards with native USB send only while it is set; through a bridge, "
              "its change resets the board (serial, lines, pans)."),
    Parameter("mode", "host", "Where the model runs: on the host or on the device (serial).",
              choices=("host", "device"), live=True),
    Parameter("offsets", "", "Offsets for a board in mode device, as in the mitigator (serial).",
              live=True, or_number=True),
    Parameter("board_model", "", "Expected model id of the board, eight hexadecimal digits; corrections by "
              "another model are not published. Empty: any (serial)."),
    *RADIO,
    Parameter("radio.tags", "", "Addresses of the tags of an anchor, separated by commas; empty: 1 (uci).",
              live=True, or_number=True, or_array=True),
    Parameter("capture", "", "File for the raw bytes of the boards, which `path` replays; an existing file is replaced, but after a crash "
              "the driver continues in NAME_2. Empty: none (uci, lines, pans)."),
    Parameter("record", "", "MCAP bag to which the raw ranges are written, completed when the node ends or is cleaned up; an "
              "existing or unfinished file is refused, but after a crash the driver continues in NAME_2. Empty: none."),
    Parameter("radio.reset", "", "Reset line of the chip, such as gpiochip0:25; empty: not connected (spi)."),
    Parameter("frame_id", "uwb_antenna", "Frame id of the receiving antenna, if the source contains none."),
    _SENSOR_RANGES,
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip

MITIGATOR = (
    Parameter("model", "auto", "Model to correct with: auto, for each range the first of universal, universal_amplitude and "
              "dw3000_sts (experimental) that fits its radio and CIR; the name of one of these or evk1000_apartment; or a "
              "file. An invalid model is refused, and the previous one stays in use.", live=True),
    Parameter("offsets", "", "Offset of ranges due to antenna delays, subtracted before the model: a number in "
              "metres, or a file written by `uwb-mitigation offset` or `calibrate`; empty: 0. Invalid "
              "offsets are refused, and "
              "the previous ones stay in use.", live=True, or_number=True),
    Parameter("backend", "onnxruntime", "Inference engine: ONNX Runtime, or the firmware's C, compiled for this "
              "computer at activation (bit-identical).", choices=("onnxruntime", "firmware")),
    _SENSOR_RANGES,
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip

LOCATOR = (
    Parameter("anchors", "", "YAML file with the positions of the anchors, `anchors: [{id: 1, x: 0.0, y: 0.0, z: 2.1}]`, or a topic: "
              "markers:/TOPIC (MarkerArray, marker id = anchor id) or poses:/TOPIC (PoseArray, index = anchor id). Required."),
    Parameter("ranges", "", "Topic of raw ranges (RangeCir) to use without a mitigator, such as uwb/range_raw; or a mapping "
              "file, or the name of a shipped mapping, for messages of other software. Empty: uwb/range_corrected."),
    Parameter("tag", 0, "Number of the tag whose topics have the plain names; others use uwb/tag_N/pose and "
              "so on. 0: the first received tag.", low=0, high=2**63 - 1),
    Parameter("level", False, "The antenna of the tag has the constant height `height`."),
    Parameter("height", 0.0, "Height of the antenna of the tag in the frame of the anchors, if it is constant.",
              low=-1e4, high=1e4, unit="m"),
    Parameter("height_sd", 0.1, "Standard deviation of that height.", low=0.001, high=100.0, unit="m"),
    Parameter("area", "", "Area of possible tag positions, X,Y,Z,X,Y,Z: two corners of a box, m. Empty: unlimited."),
    Parameter("acceleration", 0.8, "Process noise: change of the speed of tags; 0.8 for robots, people and drones.",
              low=0.001, high=1000.0, unit="m/s^1.5"),
    Parameter("range_sd", 0.1, "Standard deviation of ranges without a variance.",
              low=0.001, high=100.0, unit="m"),
    Parameter("stamp_offset", 0.0, "Offset that is added to the stamps of ranges: -0.2 if they are 0.2 s late.",
              low=-10.0, high=10.0, unit="s"),
    Parameter("rate", 50.0, "Maximum rate of estimates of a tag; 0: one for each range.",
              low=0.0, high=10_000.0, unit="Hz"),
    Parameter("height_topic", "", "Topic with the height of the only tag: z of a PoseWithCovarianceStamped. Empty: none."),
    Parameter("map_frame", "map", "Frame of the anchors."),
    Parameter("tag_frame", "uwb_tag", "Frame of the tag with the plain topic names: child frame of uwb/odometry and "
              "/tf. It is at the antenna and has the axes of map_frame. Other tags use tag_N. The namespace "
              "of the node is prepended. Do not use a frame of the robot such as base_link: its heading is unknown here, and a "
              "frame has only one parent in tf."),
    Parameter("lever_arm", "", "Position X,Y,Z of the antenna in the robot's frame, m. With a lever arm, uwb/pose and "
              "uwb/pose_smoothed are the position of the robot's origin. While the heading is unknown, a horizontal arm "
              "only widens the covariance. Empty: from /tf_static with `odometry`, otherwise 0,0,0."),
    Parameter("odometry", "", "Topic of the robot's odometry (nav_msgs/Odometry): pose increments or twists, with "
              "covariances. The locator then estimates the heading of the robot with the tag with the plain topic names. "
              "Empty = ranges only."),
    Parameter("imu", "", "Topic of the robot's IMU (sensor_msgs/Imu, z axis up); its yaw rate replaces that of "
              "`odometry`. Empty = none."),
    Parameter("imu_orientation", False, "Use differences of the IMU's orientation instead of its yaw rate."),
    Parameter("base_frame", "", "Frame of the robot: child frame of uwb/odometry with `odometry`. Empty = child frame of "
              "the odometry."),
    Parameter("transform_tolerance", 1.0, "With `odometry`, map to odom is valid for this time after the stamp of the "
              "estimate, as in AMCL.", low=0.0, high=60.0, unit="s"),
    Parameter("publish_tf", False, "Publish map_frame to the frame of each tag on /tf, for display and lookups. The "
              "frame is a leaf without heading. With `odometry`, publish map_frame to the frame of the odometry (odom) "
              "for the robot's tag instead, once the heading is known."),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip

VIEWER = (
    Parameter("host", "localhost", "Address of the web server; 0.0.0.0: all addresses of this machine."),
    Parameter("port", 5006, "Port of the web server; 0: a free port, which is logged.", low=0, high=65535),
    Parameter("origins", "", "Additional HOST:PORT that are accepted in the HTTP headers Host and Origin, separated by commas."),
    Parameter("token", "", "The URL of the page must end with ?token= and this text; generate: a random token, which is logged "
              "with the URL. Empty: no protection."),
    Parameter("anchors", "", "Anchors file for a map without a locator; the anchors are also published as "
              "markers for RViz and Foxglove. Empty: markers of a locator."),
    Parameter("map_frame", "map", "Frame of the anchors."),
    Parameter("window", 157, "Window of the network, which is marked in the CIR.", low=1, high=1016),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip

PX4 = (
    Parameter("mode", "positions", "What is sent: positions (uwb/pose, as external vision), or ranges (uwb/range_corrected, which "
              "EKF2 of PX4 1.18 fuses itself).", choices=("positions", "ranges")),
    Parameter("anchors", "", "YAML file with the positions of the anchors (ranges)."),
    Parameter("origin", "", "Latitude, longitude (degrees) and altitude above mean sea level (m) of the origin of the anchors' frame, "
              "whose x is true east and y true north. Empty: the origin of PX4's local frame (ranges)."),
    Parameter("tag", 0, "Number of the tag on the vehicle; 0: the only tag (ranges).", low=0, high=2**63 - 1),
    Parameter("autostart", True, "Configure and activate without a lifecycle manager."),
)  # fmt: skip

RESPAWN_FOLDER = "UWB_MITIGATION_RESPAWN_FOLDER"
"""Environment variable with a folder that exists while a launch file runs. A respawned node finds there the parameters
that were set at run time, the locator also its latest state, and the driver whether its recording has ended."""

REFUSED = 1
"""Exit code of a node that refuses a parameter, a file or a name at its start. A node that crashes has another one, with
which a launch file respawns it."""

DAMAGED = 74
"""Exit code of a driver after a damaged recording (EX_IOERR of sysexits.h)."""

CRASHED = 70
"""Exit code of a node after an exception that it does not handle (EX_SOFTWARE of sysexits.h)."""

STANDARD = ("qos_overrides.", "use_sim_time", "start_type_description_service")
"""Prefixes of the parameters that rclpy declares for every node."""

TABLES: dict[str, tuple[Parameter, ...]] = {
    "driver": DRIVER,
    "mitigator": MITIGATOR,
    "locator": LOCATOR,
    "viewer": VIEWER,
}
"""Tables of the nodes that launch files start."""

ALL_TABLES = TABLES | {"px4": PX4}


def help_text(name: str) -> str:
    """Return the text of `NODE --help`: usage and parameters of an executable."""
    nodes = ("driver", "mitigator", "locator") if name == "pipeline" else (name,)
    rows = {row.name: row for node in nodes for row in ALL_TABLES.get(node, ())}
    lines = [f"usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] ...]"]
    if rows:
        lines.append("parameters with their defaults (* = can be set while the node runs):")
    for row in rows.values():
        lines.append(f"  {row.name}:={row.default_text}{' *' if row.live else ''}")
        lines.append(f"      {row.description} ({row.valid})")
    return "\n".join(lines)
