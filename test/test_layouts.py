"""Layouts of RViz and Foxglove: their topics and fields exist in the nodes, with types that the displays support."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from browser import Browser
from conftest import REPOSITORY

from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.poses import tag_topic
from uwb_mitigation.types.tracks import Estimate
from uwb_mitigation.viewer import palette

TAGS = [tag_topic(topics.POSE, number) for number in (1, 2, 3)]
TYPES = topics.TYPES | dict.fromkeys(TAGS, topics.POSE_TYPE)
CIR_TYPE = "uwb_mitigation_msgs/msg/Cir"
DISPLAYS = {
    "rviz_default_plugins/MarkerArray": topics.MARKERS_TYPE,
    "rviz_default_plugins/PoseWithCovariance": topics.POSE_TYPE,
    "rviz_default_plugins/Odometry": topics.ODOMETRY_TYPE,
}
LATCHED = {topics.ANCHORS}
PATH = re.compile(r"(?P<topic>/[\w/]+)(?P<fields>(\.\w+(\[:\])?)*)")


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
    outputs = {
        re.search(r'output = "(.*)"', script["sourceCode"])[1]: dict(
            re.findall(r"(\w+): ([\w\[\]]+)", re.search(r"type Output = (.*)", script["sourceCode"])[1])
        )
        for script in layout["userNodes"].values()
    }
    for path in paths:
        found = PATH.fullmatch(path)
        assert found is not None, path
        topic, field = found["topic"], found["fields"].removeprefix(".")
        if topic in outputs:
            is_array = outputs[topic][field.removesuffix("[:]")].endswith("[]") if field else False
            assert is_array == field.endswith("[:]"), path
        else:
            assert topic in TYPES, path
            assert not field or has(TYPES[topic], found["fields"]), path
    fields = {kind: set(dict(schemas.typestore().fielddefs[kind][1])) for kind in (*TYPES.values(), CIR_TYPE)}
    for script in layout["userNodes"].values():
        source = script["sourceCode"]
        inputs = json.loads(re.search(r"inputs = (\[.*\])", source)[1])
        names = re.search(r"const \{ (.*) \} = event.message", source)[1].split(", ")
        assert set(names) <= set.union(*(fields[TYPES[topic]] for topic in inputs))
        assert set(re.findall(r"\bcir\.(\w+)", source)) <= fields[CIR_TYPE]


def test_foxglove_scripts_filter_64_bit_ids_and_compute_magnitudes(browser: Browser):
    layout = json.loads((REPOSITORY / "foxglove" / "uwb.json").read_text())

    def run(name: str, topic: str, message: str, **variables: str) -> object:
        source = layout["userNodes"][name]["sourceCode"]
        assert f'"{topic}"' in re.search(r"inputs = (.*)", source)[1]
        source = re.sub(
            r"import .*|type Output.*|: any\b|: Output \| undefined|export default |export ", "", source
        )
        event = f"{{topic: '{topic}', message: {message}}}"
        return browser.run(f"{source}; return script({event}, arguments[0]) ?? null", variables)

    big = str(2**64 - 1)
    cir = f"{{anchor_id: {big}n, tag_id: 7n, cir: {{encoding: 0, scale: 2, samples: new Int16Array([3, 4, 0, 1]),"
    cir += " start_index: 730, first_path_index: 731.5}}"
    shown = run("uwb-cir", "/uwb/range_raw", cir, anchor=big, tag="")
    assert shown == {"anchor": big, "tag": "7", "magnitude": [10, 2], "first_path": [0, 10]}
    assert run("uwb-cir", "/uwb/range_raw", cir, anchor=str(2**64 - 2), tag="") is None
    assert run("uwb-cir", "/uwb/range_raw", cir, anchor="", tag="8") is None
    ranges = f"{{anchor_id: {big}n, tag_id: 7n, range: 4.5, range_raw: 5, status: 0}}"
    shown = run("uwb-range", "/uwb/range_corrected", ranges, anchor=big, tag="7")
    assert (shown["raw"], shown["corrected"]) == (5, 4.5)
    assert run("uwb-range", "/uwb/range_truth", ranges)["truth"] == 4.5
    odometry = "{header: {frame_id: 'map'}, pose: {pose: {position: {x: 1}}, covariance: []}}"
    place = run("uwb-truth", "/uwb/odometry_truth", odometry)
    assert place == {"header": {"frame_id": "map"}, "pose": {"position": {"x": 1}}}


@pytest.mark.parametrize("path", ["foxglove/uwb.json", "rviz/uwb.rviz", "plotjuggler/uwb.xml"])
def test_layouts_show_several_tags(path: str):
    text = (REPOSITORY / path).read_text()
    assert all(topic in text for topic in TAGS)


def test_plotjuggler_shows_fields_of_the_topics():
    root = ElementTree.parse(REPOSITORY / "plotjuggler" / "uwb.xml").getroot()
    functions = {snippet.get("name") for snippet in root.iter("snippet")}
    names = {curve.get("name") for curve in root.iter("curve")} - functions
    names |= {element.text for tag in ("linked_source", "v1") for element in root.iter(tag)}
    assert len(names) > 5
    for function in root.iter("function"):
        assert function.text.endswith("else return {} end"), "without a value PlotJuggler removes the curve"
    for name in names:
        topic = next(topic for topic in TYPES if name.startswith(f"{topic}/"))
        assert has(TYPES[topic], name.removeprefix(topic).replace("/", ".")), name


def test_markers_have_the_colours_and_symbols_of_the_page():
    markers = pytest.importorskip("uwb_mitigation.nodes.markers")
    anchors = AnchorMap([Anchor(id_, (4.0 * id_, 0.0, 2.0)) for id_ in range(len(Status))])
    picture = markers.TagPicture("tag_7")
    picture.add(Estimate(0, np.array([1.0, 2.0, 0.0]), np.zeros(3), np.eye(6)))
    picture.statuses = dict(enumerate(Status))
    shown = {m.ns: m for m in markers.tag_markers(picture, list(picture.statuses), anchors, "map", 0, 0)}
    assert set(shown) == {"rays", "statuses", "tags", "tag_names", "ellipses", "trails"}
    assert shown["tag_names"].text == "tag_7"
    looks = palette.STATUS_LOOKS
    assert len(shown["statuses"].points) == sum(len(look.triangles) for look in looks.values())
    for status, colour in zip(Status, shown["rays"].colors[::2], strict=True):
        code = "#" + "".join(f"{round(255 * part):02x}" for part in (colour.r, colour.g, colour.b))
        assert code == (looks[status].colour or palette.NIGHT)
