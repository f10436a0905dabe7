"""Parameters of the nodes: checks, unknown names, and QoS overrides."""

import json
import math
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from bag_material import write_records

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from ros_harness import PAUSED, Ros, diagnostic_values, domain
from uwb_mitigation_msgs.msg import RangeCir

from uwb_mitigation.nodes.support.parameter_tables import RESPAWN_FOLDER, TABLES, Parameter
from uwb_mitigation.nodes.support.respawn import StateFile
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Record

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def replaying(tmp_path_factory: pytest.TempPathFactory):
    """A domain with a driver that waits for the command to play."""
    with domain(tmp_path_factory.mktemp("driver")) as ros:
        ros.start("driver", "paused:=true", "wait_for_subscribers:=0", "start_delay:=0.0")
        yield ros


@pytest.mark.parametrize(
    ("name", "value", "excerpt"),
    [
        *(
            ("rate", value, ("rate", str(value), "0.001", "10000"))
            for value in (-1.0, 20_000, math.nan, "fast")
        ),
        ("paused", 1, ("paused", "1", "true or false")),
        ("mode", "cloud", ("mode", "cloud", "host, device")),
        ("seek_to", -5.0, ("seek_to", "-5.0", "1000000000")),
        ("seed", 7, ("seed", "read-only")),
        ("rate", 3, None),
    ],
)
def test_invalid_value_is_refused_with_range(replaying: Ros, name: str, value: object, excerpt: tuple | None):
    result = replaying.set_parameter("driver", name, value)
    assert result.successful == (excerpt is None)
    assert all(word in result.reason for word in excerpt or ()), result.reason


QOS = "-p qos_overrides./uwb/range_raw.subscription"
REFUSED = {
    "driver -p sorce:=mcap": "unknown parameter 'sorce'; did you mean 'source'?",
    "pipeline -p raet:=2.0": "unknown parameter 'raet'; did you mean 'rate'",
    "mitigator -p wholly_else:=1": "unknown parameter 'wholly_else' (",
    f"mitigator {QOS}.reliability:=perhaps": "qos_overrides of /uwb/range_raw",
    f"mitigator {QOS}.depth:=deep": "qos_overrides of /uwb/range_raw",
    "driver -p source:=mcap -p path:=/nonexistent/bag.mcap": "/nonexistent/bag.mcap",
    "driver -p rate:=.nan": "rate",
    "driver -p source:=topic -p map:=string_json -p topic:=bad--x": "bad--x",
    f"driver -r __node:={'a' * 300}": "node name length should not exceed",
    f"driver -r __ns:=/{'a' * 300}": "invalid node namespace",
    f"driver -r uwb/range_raw:={'a' * 300}": "topic length should not exceed",
    "mitigator -r uwb/range_corrected:=/uwb/range_raw": "/uwb/range_raw twice",
}


def test_nodes_refuse_parameters_at_their_start(ros: Ros):
    # One process after the other would import the same libraries.
    program = (
        "import sys\n"
        "from uwb_mitigation.nodes.support.spinning import run_node\n"
        f"for words in {list(REFUSED)}:\n"
        "    node, *arguments = words.split()\n"
        "    sys.argv = [node, '--ros-args', *arguments]\n"
        "    try:\n"
        "        run_node(node)\n"
        "    except SystemExit as end:\n"
        "        print('exit code', end.code, file=sys.stderr)\n"
    )
    process = ros.run([sys.executable, "-c", program])
    assert process.wait() == 0
    *outputs, rest = process.output.split("exit code 1\n")
    assert rest == ""
    assert "Traceback" not in process.output
    pairs = zip(REFUSED.values(), outputs, strict=True)
    assert [(excerpt, output) for excerpt, output in pairs if excerpt not in output] == []


def test_live_parameters_survive_a_respawn(ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(RESPAWN_FOLDER, str(tmp_path))
    mitigator = ros.start("mitigator", "offsets:=0.1")
    mitigator.wait_for_output("correcting with")
    assert ros.set_parameter("mitigator", "offsets", 0.22).successful
    assert ros.set_parameter("mitigator", "model", "evk1000_apartment").successful
    assert ros.set_parameter("mitigator", "model", "absent.onnx").successful is False
    mitigator.signal(signal.SIGKILL)
    respawned = ros.start("mitigator", "offsets:=0.1")
    respawned.wait_for_output("correcting with model evk1000_apartment")
    assert "restored parameters after a respawn" in respawned.output
    ros.diagnosis("mitigator", lambda status: "0.22" in diagnostic_values(status).get("offsets", ""))


def test_state_of_a_crashed_node_is_loaded_once_and_only_if_it_is_new_and_valid(tmp_path: Path):
    path, warnings = tmp_path / "locator.state", []
    logger = SimpleNamespace(info=lambda text: None, warning=warnings.append)

    def load() -> object:
        return StateFile(path, logger).load(30.0, lambda state: state["yaw"])

    StateFile(path, logger).save(lambda: {"yaw": 1.0})
    saved = json.loads(path.read_text())
    assert saved == {"format": 1, "saved_s": saved["saved_s"], "state": {"yaw": 1.0}}
    respawned = StateFile(path, logger)
    assert [respawned.load(30.0, lambda state: state["yaw"]) for _ in range(2)] == [1.0, None]
    respawned.save(lambda: {"yaw": 2.0})
    assert load() == 1.0, "a state that leads to a crash becomes too old"
    path.write_text(json.dumps(saved | {"saved_s": saved["saved_s"] - 40.0}))
    assert load() is None
    assert not warnings
    invalid = [json.dumps(saved | change) for change in ({"format": 2}, {"state": {}}, {"saved_s": "now"})]
    for content in (b"\x80garbage", *map(str.encode, invalid)):
        path.write_bytes(content)
        assert load() is None
    assert len(warnings) == 4
    assert StateFile(None, logger).load(30.0, dict) is None


def test_topics_can_be_remapped_and_files_may_contain_parameters_of_other_nodes(ros: Ros, tmp_path: Path):
    bag, file = tmp_path / "no_frames.mcap", tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters: {model: '', rate: 2.0, height: 1.0, anchors: a.yaml}\n")
    source = SimulatedSource(seed=1, count=5)
    write_records(bag, (Record(replace(record.measurement, frame_id="")) for record in source))
    received = ros.collect(RangeCir, "/elsewhere")
    given = ("source:=mcap", f"path:={bag}", "frame_id:=mast", *PAUSED)
    arguments = ("-r", "uwb/range_raw:=/elsewhere", "--params-file", str(file))
    driver = ros.start("driver", *given, arguments=arguments)
    ros.play()
    ros.spin_until(lambda: len(received) == 5)
    assert {message.header.frame_id for message in received} == {"mast"}
    (line,) = [line for line in driver.output.splitlines() if "parameters of other nodes" in line]
    assert "[INFO]" in line
    assert line.endswith("anchors, height, model")


@pytest.mark.parametrize("row", [row for table in TABLES.values() for row in table], ids=lambda row: row.name)
def test_every_default_is_valid_and_every_physical_number_has_a_unit(row: Parameter):
    row.check(row.default)
    assert row.description.endswith(".") or row.description.endswith(")")
    if row.name.endswith(("delay", "wait", "pause", "seek_to", "simulated_rate", "baud")):
        assert row.unit in row.valid
        assert row.unit
