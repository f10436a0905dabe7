"""The reference pages compared with running nodes: topics, services, diagnostics, and the example of a node."""

import re
import sys
from pathlib import Path

import generated
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from conftest import REPOSITORY
from diagnostic_msgs.msg import DiagnosticArray
from ros_harness import Ros, domain
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.types.ros import topics

pytestmark = pytest.mark.ros

PAGES = {path.stem: text for path, text in generated.reference().items()}
GUIDES = REPOSITORY / "docs" / "guides"
# The nodes of this test for each entry in the table of topics.
ENTRIES = {
    "`driver`": {"driver", "board"},
    "`driver` on replay": {"driver"},
    "if the recording contains true positions": set(),
    "`driver` with `publish_clock:=true`": {"driver"},
    "`driver` with `source:=serial`": {"board"},
    "`mitigator`": {"mitigator"},
}
NODES = ("driver", "board", "mitigator")
EVERY_NODE = ("/rosout", "/parameter_events", "/transition_event")


def rows(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the tables below a heading of a reference page."""
    text = PAGES[page]
    section = text[text.index(f"{heading}\n") + len(heading) :].partition("\n#")[0]
    lines = [line for line in section.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.fixture(scope="module")
def ros(tmp_path_factory: pytest.TempPathFactory):
    """A replay, a board in mode `device`, and a mitigator for the two."""
    folder = tmp_path_factory.mktemp("reference")
    port = folder / "port"
    with domain(folder) as ros:
        model = str(default_model_path())
        ros.run([sys.executable, "-m", "benchmarks", "emulate-board", "--link", str(port), "--model", model])
        ros.start("mitigator")
        ros.start("driver", "publish_clock:=true", "start_delay:=0.0")
        serial = ("source:=serial", f"port:={port}", "mode:=device")
        ros.start("driver", *serial, arguments=("-r", "__node:=board"))
        ros.spin_until(lambda: set(NODES) <= set(ros.node.get_node_names()))
        yield ros


@pytest.mark.parametrize(
    ("column", "of_node"),
    [(2, "get_publisher_names_and_types_by_node"), (3, "get_subscriber_names_and_types_by_node")],
)
def test_nodes_have_the_topics_of_the_page(ros: Ros, column: int, of_node: str):
    documented = {
        (node, topic, row[1].strip("`"))
        for row in rows("nodes", "## Topics")
        for topic in re.findall("`([^`]+)`", row[0])
        for entry in re.split("[;,] ", row[column])
        if entry
        for node in ENTRIES.get(entry, ())
    }

    def found() -> set[tuple[str, str, str]]:
        return {
            (node, topic, kind)
            for node in NODES
            for topic, kinds in getattr(ros.node, of_node)(node, "/")
            for kind in kinds
            if not topic.endswith(EVERY_NODE)
        }

    ros.spin_until(lambda: documented <= found())
    assert found() == documented


@pytest.mark.parametrize(
    ("node", "heading"),
    [
        ("mitigator", "## `mitigator`"),
        ("driver", "## `driver` with a recording"),
        ("board", "## `driver` with a board"),
    ],
)
def test_diagnostics_have_the_keys_of_the_page(ros: Ros, node: str, heading: str):
    keys = {key for row in rows("diagnostics", heading) for key in re.findall("`([^`]+)`", row[0])}
    open_ended = tuple(key.partition(": ")[0] + ": " for key in keys if ": " in key)
    expected = {key for key in keys if ": " not in key}
    arrays = ros.collect(DiagnosticArray, topics.DIAGNOSTICS, 100)
    seen: set[str] = set()

    def look() -> bool:
        for array in arrays:
            for status in array.status:
                if status.name == f"{node}: ranges":
                    seen.update(entry.key for entry in status.values)
        arrays.clear()
        return expected <= seen

    ros.spin_until(look)
    assert {key for key in seen if not key.startswith(open_ended or ("none: ",))} == expected


def test_mitigator_receives_the_ranges_of_the_node_on_the_page_about_sources(tmp_path: Path):
    code = re.findall(r"^```python\n(.*?)^```", (GUIDES / "recordings.md").read_text(), re.M | re.S)[-1]
    with domain(tmp_path) as ros:
        received = ros.collect(RangeCorrected, "/uwb/range_corrected")
        ros.start("mitigator")
        ros.run([sys.executable, "-c", code])
        ros.spin_until(lambda: bool(received))
    message = received[0]
    assert (message.tag_id, message.anchor_id, message.status) == (7, 1, RangeCorrected.NO_CIR)
    assert message.header.frame_id == "my_antenna"
