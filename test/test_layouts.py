"""Layouts of RViz and Foxglove: their topics and fields exist in the nodes, with types that the displays support."""

from __future__ import annotations

import json
import re

import yaml
from conftest import REPOSITORY

from uwb_mitigation.bag import schemas, topics

TYPES = {
    topics.RANGE_RAW: topics.RANGE_CIR_TYPE,
    topics.RANGE_TRUTH: topics.RANGE_TRUTH_TYPE,
    topics.RANGE_CORRECTED: topics.RANGE_CORRECTED_TYPE,
    topics.POSE: topics.POSE_TYPE,
    topics.POSE_SMOOTHED: topics.POSE_TYPE,
    topics.ODOMETRY: topics.ODOMETRY_TYPE,
    topics.ODOMETRY_TRUTH: topics.ODOMETRY_TYPE,
    topics.ANCHORS: topics.MARKERS_TYPE,
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
DISPLAYS = {
    "rviz_default_plugins/MarkerArray": topics.MARKERS_TYPE,
    "rviz_default_plugins/PoseWithCovariance": topics.POSE_TYPE,
    "rviz_default_plugins/Odometry": topics.ODOMETRY_TYPE,
}
LATCHED = {topics.ANCHORS}
PATH = re.compile(
    r"(?P<topic>/[\w/]+)(?P<filter>\{(?P<by>\w+)==\$(?P<variable>\w+)\})?(?P<fields>(\.\w+(\[:\])?)*)"
)


def has(type_name: str, fields: str) -> bool:
    """Return whether a message has a field such as `.cir.samples[:]`, with arrays in the right places."""
    store = schemas.typestore()
    for word in fields.removeprefix(".").split("."):
        name, _, sliced = word.partition("[")
        found = dict(store.fielddefs[type_name][1])
        if name not in found:
            return False
        kind = found[name]
        if (int(kind[0]) in (3, 4)) != bool(sliced):
            return False
        type_name = str(kind[1]) if int(kind[0]) == 2 else type_name
    return True


def test_rviz_displays_use_existing_topics_of_their_type():
    config = yaml.safe_load((REPOSITORY / "rviz" / "uwb.rviz").read_text())["Visualization Manager"]
    assert config["Global Options"]["Fixed Frame"] == "map"
    shown = [display for display in config["Displays"] if "Topic" in display]
    assert {display["Topic"]["Value"] for display in shown} >= {
        topics.ANCHORS,
        topics.POSE,
        topics.ODOMETRY_TRUTH,
    }
    for display in shown:
        topic = display["Topic"]
        assert TYPES[topic["Value"]] == DISPLAYS[display["Class"]]
        durability = "Transient Local" if topic["Value"] in LATCHED else "Volatile"
        assert topic["Durability Policy"] == durability, topic["Value"]


def test_foxglove_layout_uses_existing_topics_and_fields():
    layout = json.loads((REPOSITORY / "foxglove" / "uwb.json").read_text())
    panels = layout["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    paths += [
        panel[key] for panel in panels.values() for key in ("topicPath", "topicToRender") if key in panel
    ]
    paths += list(panels["3D!site"]["topics"])
    assert len(paths) > 8
    for path in paths:
        found = PATH.fullmatch(path)
        assert found is not None, path
        kind = TYPES[found["topic"]]
        assert not found["fields"] or has(kind, found["fields"]), path
        if found["filter"]:
            assert has(kind, f".{found['by']}"), path
            assert found["variable"] in layout["globalVariables"], path
