"""Verdict, states of anchors, ages and counts of the viewer's page, without a browser."""

import io
import math
from collections.abc import Iterable
from types import SimpleNamespace

import numpy as np
import pytest
from browser import Browser
from drawn import Clock, Drawn
from PIL import Image

from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.positioning.health import DEGRADED, POSITION_GOOD, Verdict
from uwb_mitigation.types.anchors import Anchor
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.viewer import palette
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.histories import Pose, Sample
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import NodeStatus, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View
from uwb_mitigation.viewer.verdict import LOOKS, NOT_CORRECTED, HeldVerdict, predicted_accuracy

CIRCLE = NodeStatus(1, "", math.nan, ("tag 7 determination: circle: R. Remedy: more anchors",))
ANCHORS = {1: (0.0, 0.0), 2: (8.0, 0.0), 3: (0.0, 6.0), 4: (8.0, 6.0)}


def driven(
    errors_m: dict[int, float] | None = None,
    status: Status = Status.OK,
    count: int = 30,
    sd_m: float = 0.1,
    senders: Iterable[int] = ANCHORS,
) -> tuple[Scene, Clock]:
    """Return a scene with ranges of four anchors to a tag at (4, 3), with an error for each anchor."""
    scene = Scene(clock := Clock())
    scene.stamp_clock = lambda: clock.now_s + 900.0
    scene.set_anchors(
        [Anchor(id_, (x, y, 0.0), name="door" if id_ == 2 else "") for id_, (x, y) in ANCHORS.items()]
    )
    for _ in range(count):
        clock.now_s += 0.1
        scene.add_pose("tag_7", Pose(4.0, 3.0, 0.0, stamp_s=clock.now_s + 900.0, sd_m=sd_m))
        for anchor in senders:
            range_m = 5.0 + (errors_m or {}).get(anchor, 0.0)
            scene.add_sample((anchor, 7), Sample(clock.now_s + 900.0, range_m, range_m, 0.1, status))
    return scene, clock


def shown(scene: Scene) -> Drawn:
    return Drawn(View(scene))


def controls(scene: Scene):
    return shown(scene).controls


def test_good_position_has_its_accuracy_age_and_share_of_corrected_ranges():
    scene, clock = driven()
    clock.now_s += 1.0
    state, reason, _, *facts = controls(scene).verdict
    assert (state, reason) == ("good", "")
    assert facts == [
        "horizontal sd 0.10 m, 95 % within 0.17 m \u00b7 last range 1.0 s old by stamp",
        "Since the start: ranges corrected: 100.0 % (120 of 120 ranges)",
    ]


def test_anchor_that_is_not_where_the_file_says_is_named_while_the_tag_moves():
    scene, clock = driven(count=1)
    for angle in np.arange(0.0, 40.0, 0.1).tolist():
        clock.now_s += 0.1
        x, y, stamp_s = 4.0 + 3.0 * math.cos(angle), 3.0 + 2.0 * math.sin(angle), clock.now_s + 900.0
        scene.add_pose("tag_7", Pose(x, y, 0.0, stamp_s=stamp_s, sd_m=0.1))
        for anchor, (anchor_x, anchor_y) in (ANCHORS | {2: (8.0, 0.8)}).items():
            range_m = math.hypot(x - anchor_x, y - anchor_y)
            scene.add_sample((anchor, 7), Sample(stamp_s, range_m, range_m, 0.1, Status.OK))
    state, reason, action, *_ = controls(scene).verdict
    assert (state, reason) == ("degraded", "Anchor door is probably not where the anchors file says")
    assert action.startswith("At least 0.8 m away")


def test_anchor_that_reads_long_degrades_the_position_by_its_name():
    scene, _ = driven({2: 0.6})
    state, reason, action, *_ = controls(scene).verdict
    assert (state, reason) == ("degraded", "Anchor door reads 0.60 m long")
    assert action == "Check its position, or run `uwb-mitigation calibrate`."
    page = shown(scene)
    assert page.column("map", "label") == ["1 \u2713 selected", "door \u2297 +0.6 m", "3 \u2713", "4 \u2713"]
    assert page.column("map", "health")[1] == health.BAD
    assert page.column("pairs", "state").count(health.BAD) == 1


def test_marks_of_anchors_have_the_colours_of_their_states(browser: Browser):
    scene = driven({2: 0.6, 3: 0.2}, senders=(1, 2, 3))[0]
    states = health.GOOD, health.BAD, health.CHECK, health.SILENT

    def colours() -> list[str]:
        """Return the colours of the marks next to their centres."""
        places = browser.run(
            "const {frame, el} = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('map'));"
            "const {left, top} = el.getBoundingClientRect();"
            "return arguments[0].map(([x, y]) => [left + frame.x_scale.compute(x), top + frame.y_scale.compute(y)])",
            list(ANCHORS.values()),
        )
        screen = Image.open(io.BytesIO(browser.driver.get_screenshot_as_png())).convert("RGB")
        pixels = [screen.getpixel((round(x) + 3, round(y))) for x, y in places]
        return ["#" + bytes(pixel).hex() for pixel in pixels]

    with ViewerServer(View(scene), port=0) as server:
        browser.open(server.url)
        browser.wait("the page", browser.ready)
        browser.wait("the marks", lambda: colours() == [LOOKS[state][1] for state in states])


def test_anchor_to_check_is_named_below_a_good_position():
    state, reason, action, *_ = controls(driven({2: 0.2})[0]).verdict
    assert (state, reason) == ("good", "")
    assert action == "Anchor door reads 0.20 m long: check its position, or run `uwb-mitigation calibrate`."


def test_each_tag_has_a_verdict_and_a_track_of_its_own_colour():
    scene, clock = driven()
    for stamp_s in (902.9, 903.0):
        scene.add_pose("tag_9", Pose(1.0, 2.0, 0.0, stamp_s=stamp_s, sd_m=0.1))
        scene.add_sample((1, 9), Sample(stamp_s, 5.0, 5.0, 0.1, Status.OK))
    clock.now_s += 4.0
    scene.add_pose("tag_7", Pose(4.0, 3.0, 0.0, stamp_s=907.0, sd_m=0.1))
    for anchor in ANCHORS:
        scene.add_sample((anchor, 7), Sample(907.0, 5.0, 5.0, 0.1, Status.OK))
    page = shown(scene)
    assert [row[:2] for row in page.controls.tag_rows] == [["tag 7", "good"], ["tag 9", "lost"]]
    first, second = palette.TAG_COLOURS[:2]
    assert page.columns("map", "colour")[-2:] == [palette.GREY, first], "tag 7 moved last"
    assert {first, second} <= set(page.columns("map", "colour")), "the track of a lost tag keeps its colour"


def test_anchor_that_is_bad_for_another_tag_does_not_degrade_this_one():
    scene, clock = driven()
    for _ in range(30):
        clock.now_s += 0.1
        for tag, wrong in ((7, None), (9, 2)):
            scene.add_pose(f"tag_{tag}", Pose(4.0, 3.0, 0.0, stamp_s=clock.now_s + 900.0, sd_m=0.1))
            for anchor in ANCHORS:
                range_m = 5.0 + 0.9 * (anchor == wrong)
                scene.add_sample((anchor, tag), Sample(clock.now_s + 900.0, range_m, range_m, 0.1, Status.OK))
    page = controls(scene)
    assert page.verdict[:2] == ["good", ""], "of tag 7"
    assert [row[:2] for row in page.tag_rows] == [["tag 7", "good"], ["tag 9", "degraded"]]
    assert {row[1]: row[0] for row in page.health}["2 (door)"] == health.BAD


def test_position_of_a_lost_tag_is_the_last_one_without_accuracy():
    scene, clock = driven()
    clock.now_s += 12.0
    assert shown(scene).controls.tag_rows[0][1:5] == [
        "lost",
        "last: 4.00, 3.00, 0.00",
        "-",
        "no data for 12 s",
    ]


@pytest.mark.parametrize(("error_m", "state"), [(0.2, health.CHECK), (0.4, health.BAD)])
def test_verdict_and_table_agree_on_a_common_offset(error_m: float, state: str):
    page = controls(driven(dict.fromkeys(ANCHORS, error_m))[0])
    reason = f"All anchors read too long, {error_m:.2f} m in the median"
    assert page.verdict[:2] == ["degraded", reason]
    assert page.verdict[2].startswith(
        "A common cause is likely. Check the height and the anchors file, or calibrate"
    )
    assert page.health[0][0] == state
    assert page.health[0][-1].startswith(reason)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda scene, clock: setattr(clock, "now_s", clock.now_s + 12.0), ("lost", "no ranges of tag 7 for 12 s")),
        (lambda scene, clock: scene.tags.clear(), ("not determined", "no position of tag 7")),
        (lambda scene, clock: scene.set_node_status("locator", CIRCLE), ("degraded", "circle: R")),
        (lambda scene, clock: scene.add_pose("tag_7", Pose(4, 3, 0, sd_m=0.9)), ("degraded", "uncertain by 0.90 m")),
        (lambda scene, clock: scene.add_pose("tag_7", Pose(4, 3, 0)), ("degraded", "its standard deviation is unknown")),
    ],
)  # fmt: skip
def test_verdict_names_the_reason(change, expected: tuple[str, str]):
    scene, clock = driven()
    change(scene, clock)
    assert tuple(controls(scene).verdict[:2]) == expected


def test_silent_anchors_are_named_before_the_geometry_of_the_others():
    scene = driven(senders=(1, 2))[0]
    scene.tags.clear()
    scene.set_node_status("locator", CIRCLE)
    page = shown(scene)
    state, reason, action, *_ = page.controls.verdict
    assert (state, reason) == ("not determined", "only anchors 1 and 2 send ranges; no ranges from 3, 4")
    assert action.startswith("Find out why: check power")
    assert action.endswith("Without them: more anchors.")
    assert [row[:2] for row in page.controls.health[2:]] == [[health.SILENT, "3"], [health.SILENT, "4"]]
    assert page.column("map", "health")[2:] == [health.SILENT] * 2


def test_better_verdict_is_held_back_and_a_seek_is_not():
    held = HeldVerdict()
    states = [held.update(Verdict(state), now_s).state
              for state, now_s in ((DEGRADED, 0.0), (POSITION_GOOD, 1.0), (DEGRADED, 1.5), (POSITION_GOOD, 2.0), (POSITION_GOOD, 3.0), (POSITION_GOOD, 4.1),
                                   (DEGRADED, 4.2), (POSITION_GOOD, 90.0))]  # fmt: skip
    assert states == [DEGRADED] * 5 + [POSITION_GOOD, DEGRADED, POSITION_GOOD]


@pytest.mark.parametrize(
    ("changes", "before", "expected"),
    [
        ({}, "", health.GOOD),
        ({"rate": 0.0}, "", health.UNKNOWN),
        ({"residual": math.nan}, "", health.UNKNOWN),
        ({"evidence": 3.0}, "", health.UNKNOWN),
        ({"evidence": 3.0, "residual": 0.9}, "", health.UNKNOWN),
        ({"residual": 0.4}, "", health.BAD),
        ({"residual": 0.4, "nlos": 90.0}, "", health.CHECK),
        ({"residual": 0.27}, "", health.CHECK),
        ({"residual": 0.27}, health.BAD, health.BAD),
        ({"residual": 0.13}, health.CHECK, health.CHECK),
        ({"stopped": 5.0}, "", health.BAD),
        ({"displaced": 0.4, "fit_x": 1.0, "fit_y": 2.0, "moved": 0.8}, "", health.BAD),
    ],
)
def test_state_of_an_anchor_needs_evidence_and_has_hysteresis(
    changes: dict[str, float], before: str, expected: str
):
    means = dict.fromkeys(("nlos", "lost", "not_ok", "residual", "stopped", "displaced"), 0.0)
    means |= {"rate": 10.0, "evidence": 100.0}
    assert health.state(means | changes, before) == expected


def test_radio_without_cirs_is_a_normal_state():
    page = shown(driven(status=Status.NO_CIR)[0])
    state, reason, action, _, facts = page.controls.verdict
    assert (state, reason, action) == ("good", "not corrected", NOT_CORRECTED)
    assert facts.endswith(
        "correction: none (the radio sends no CIRs) \u00b7 ranges corrected: none (0 of 120 ranges: no CIRs)"
    )
    assert "not corrected" in page.column("map", "kind")
    assert "corrected" not in page.column("map", "kind")
    _, reason, action, _, facts = controls(driven(status=Status.BAD_CIR)[0]).verdict
    assert (reason, "CIRs" in action) == ("not corrected", False)
    assert facts.endswith("none (0 of 120 ranges; 120 not corrected (see their status))")
    facts = controls(driven(status=Status.UNRELIABLE)[0]).verdict[4]
    assert facts.endswith("100.0 % (120 of 120 ranges; 120 of these uncertain)")
    assert {row[0] for row in page.controls.health} == {health.GOOD}
    assert page.cards()["Ranges corrected, since the start"] == ("none", "0 of 120 ranges: no CIRs")


def test_verdict_says_whether_the_ranges_of_this_tag_are_corrected_now():
    scene, clock = driven()
    for anchor_id in ANCHORS:
        scene.add_sample((anchor_id, 8), Sample(clock.now_s + 900.0, 5.0, 5.0, 0.1, Status.OK))
    assert controls(scene).headline == "Position of tag 7 good"
    for anchor_id in ANCHORS:
        status = Status.BAD_CIR if anchor_id == min(ANCHORS) else Status.NO_CIR
        scene.add_sample((anchor_id, 7), Sample(clock.now_s + 900.01, 5.0, 5.0, 0.1, status))
    assert controls(scene).verdict[:3] == ["good", "not corrected", NOT_CORRECTED]


@pytest.mark.parametrize("status", [Status.OK, Status.NO_CIR])
def test_correction_has_a_figure_only_if_ranges_were_corrected(status: Status):
    scene, clock = driven({1: 0.3}, status)
    for tenth in range(-30, 1):
        scene.add_pose("tag_7", Pose(4.1, 3.0, 0.0, stamp_s=clock.now_s + 900.0 + tenth / 10), TrackKind.TRUE)
    assert ("Correction, last 60 s" in shown(scene).cards()) == (status is Status.OK)


@pytest.mark.parametrize(
    ("arm", "heading_rad", "antenna"),
    [
        ("0.300,0.000,0.500", math.pi / 2, (1.0, 2.3, 0.5)),
        ("0.300,0.000,0.500", math.nan, (1.0, 2.0, 0.5)),
        ("nan,0,0", 0.0, (1.0, 2.0, 0.0)),
        ("text", 0.0, (1.0, 2.0, 0.0)),
    ],
)
def test_residuals_are_those_of_the_antenna(
    arm: str, heading_rad: float, antenna: tuple[float, float, float]
):
    scene = Scene(Clock())
    scene.set_anchors([Anchor(1, (4.0, 6.0, 2.5))])
    entries = [SimpleNamespace(key="tag 7 lever arm", value=arm)]
    diagnosis = SimpleNamespace(status=[SimpleNamespace(name="locator", level=0, message="", values=entries)])
    SceneUpdater(scene).add("/diagnostics", diagnosis)
    scene.add_pose("tag_7", Pose(1.0, 2.0, 0.0, heading_rad=heading_rad, stamp_s=1.0))
    range_m = math.dist(antenna, (4.0, 6.0, 2.5)) + 0.2
    scene.add_sample((1, 7), Sample(1.0, range_m, range_m, 0.1, Status.OK))
    assert scene.pairs[1, 7].columns.residual_m.tolist() == [pytest.approx(0.2)]


def test_pairs_tags_and_nodes_without_data_are_marked():
    scene, clock = driven()
    states = ((7, "circle: R"), (8, "unique: R"))
    entries = [SimpleNamespace(key=f"tag {n} determination", value=state) for n, state in states]
    diagnosis = SimpleNamespace(status=[SimpleNamespace(name="locator", level=1, message="", values=entries)])
    SceneUpdater(scene).add("/diagnostics", diagnosis)
    scene.set_node_status("driver", NodeStatus(0, "10.0 Hz", clock()))
    scene.set_node_status("recording", NodeStatus(2, "damaged"))
    page = shown(scene)
    assert page.controls.notice == ["tag 7 determination: circle: R"]
    assert page.column("pairs", "no_data") == [False] * 4
    assert page.column("map", "x1") == [4.0] * 4
    clock.now_s += 12.0
    page.send("draw")
    assert page.column("pairs", "status") == ["no data for 12 s"] * 4
    assert page.column("pairs", "rate") == [0.0] * 4
    assert [row[3:6] for row in page.controls.health[1:]] == [["-"] * 3] * 4, "no old means"
    assert page.column("map", "x1") == []
    assert "tag 7: no data for 12 s" in page.columns("map", "name")
    assert page.controls.nodes == [
        ["driver", "STALE", "no diagnostics for 12 s; last: 10.0 Hz"],
        ["locator", "STALE", "no diagnostics for 12 s; last: "],
        ["recording", "ERROR", "damaged"],
    ]
    assert page.controls.headline == "Position lost: no ranges of tag 7 for 12 s"
    assert page.controls.notice == []
    assert page.controls.health[0][-1].startswith("No anchor answers: check the tag")
    scene.add_sample((1, 7), Sample(clock.now_s + 900.0, 5.0, 5.0, 0.1, Status.OK))
    page.send("draw")
    assert page.column("pairs", "status")[0] == "OK"


def test_map_has_heading_ellipse_and_a_legend_of_what_it_contains():
    scene, _ = driven()
    scene.add_pose("tag_7", Pose(4.0, 3.0, 0.0, stamp_s=1000.0), TrackKind.TRUE)
    page = shown(scene)

    def legend() -> set[str]:
        legends = page.document.get_model_by_name("map").legend
        items = [item for legend in legends if legend.visible for item in legend.items if item.visible]
        fields = {item.label.field for item in items if hasattr(item.label, "field")}
        return {value for field in fields for value in page.column("map", field)} | {
            item.label.value for item in items if hasattr(item.label, "value")
        }

    assert legend() == {"raw", "corrected", "true", "last range: OK", "tag", *LOOKS}
    states = page.document.get_model_by_name("map").legend[1].items
    assert [item.label.value for item in states] == list(LOOKS)
    assert page.column("map", "ink") == [palette.PAPER, *[palette.NIGHT] * 3], "the selected anchor"
    scene.add_pose("tag_7", Pose(4, 3, 1, 0.4, 0.2, 0.3, 0.5, stamp_s=1003.0))
    page.send("draw")
    assert legend() >= {"95 % ellipse", "heading"}
    assert (page.column("map", "heading"), page.column("map", "width")) == ([0.5], [0.8])


def test_predicted_accuracy_is_shown_on_request():
    page = shown(driven()[0])
    assert page.column("map", "step") == []
    page.send("accuracy", True)
    steps = [f"sd \u2264 {limit} m" for limit in ("0.1", "0.2", "0.5", "1", "10")]
    assert page.column("map", "step") == steps
    page.send("accuracy", False)
    assert page.column("map", "step") == []
    anchors = np.array([[0.0, 0.0, 1.0], [8.0, 0.0, 1.0], [8.0, 8.0, 1.0], [0.0, 8.0, 1.0]])
    x, y, image = predicted_accuracy(anchors, 1.0, 0.1)
    place = np.array([x[20], y[25], 1.0])
    assert image[25, 20] == pytest.approx(0.1 * dop(anchors, place, level=True).hdop, rel=1e-5)
    assert np.isinf(predicted_accuracy(anchors[:1], 1.0, 0.1)[2]).all()


@pytest.mark.parametrize(
    ("residuals_m", "nlos", "expected"),
    [
        ([0.0, 0.8, 0.0], [0.0, 94.0, 0.0], "Anchor 2 reads 0.80 m long, with 94 % NLOS: its line of sight"),
        ([0.0, -0.4, 0.0], [0.0, 0.0, 0.0], "Anchor 2 reads 0.40 m short: check its position"),
        ([0.2, 0.8, 0.3], [0.0, 94.0, 0.0], "All anchors read too long, 0.30 m in the median: a common cause"),
        ([0.2, -0.8, 0.3], [0.0, 0.0, 0.0], "The ranges of all anchors contradict the position: check ids"),
        ([0.2, 0.8, 0.3], [90.0, 94.0, 60.0], "The ranges of all anchors contradict the position, and most are NLOS"),
        ([math.nan] * 3, [math.nan] * 3, ""),
    ],
)  # fmt: skip
def test_advice_names_the_probable_cause(residuals_m: list[float], nlos: list[float], expected: str) -> None:
    others = dict.fromkeys(("rate", "lost", "not_ok", "stopped", "displaced"), 0.0) | {"evidence": 100.0}
    anchors = {
        number: others | {"nlos": share, "residual": residual_m}
        for number, (residual_m, share) in enumerate(zip(residuals_m, nlos, strict=True), 1)
    }
    common, advice = health.advice(anchors)
    texts = [text for text in (common, *advice.values()) if text]
    assert len(texts) == (expected != "")
    assert "".join(texts).startswith(expected)


def test_clock_jump_dead_tag_and_old_stamps_are_reported():
    scene, clock = driven()
    for late_s in (11.8, 11.7):
        scene.add_sample((1, 9), Sample(clock.now_s + 900.0 - late_s, 5.0, 5.0, 0.1, Status.OK))
    for _ in range(2):
        clock.now_s += 0.1
        for anchor in ANCHORS:
            scene.add_sample((anchor, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    page = controls(scene)
    assert page.incidents == [(None, "0 s ago: clock of tag 7: jump by +3600 s")]
    assert [(row[0], row[-1]) for row in page.tag_rows] == [("tag 7", "-3600.0 s"), ("tag 9", "11.9 s")]
    clock.now_s += 5.0
    scene.add_sample((1, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    page = controls(scene)
    assert (None, "5 s ago: tag 9: lost") in page.incidents
    assert page.tag_rows[1][4:] == ["no position", "0.0", "16.9 s"]


def test_pause_of_a_bag_does_not_hide_why_there_is_no_position():
    scene, clock = driven(senders=[1, 2])
    scene.tags.clear()
    # The stamps continue where the bag was paused.
    begin_s, clock.now_s = clock.now_s + 900.0, clock.now_s + 30.0
    for tenth in range(1, 31):
        clock.now_s += 0.1
        for anchor in (1, 2):
            scene.add_sample((anchor, 7), Sample(begin_s + tenth / 10, 5.0, 5.0, 0.1, Status.OK))
    assert controls(scene).verdict[1] == "only anchors 1 and 2 send ranges; no ranges from 3, 4"


@pytest.mark.parametrize(("has_position", "state"), [(True, "lost"), (False, "not determined")])
def test_jump_of_a_clock_is_the_reason_of_a_missing_position(has_position: bool, state: str):
    scene, clock = driven()
    if not has_position:
        scene.tags.clear()
    for _ in range(40):
        clock.now_s += 0.1
        for anchor in ANCHORS:
            scene.add_sample((anchor, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    verdict = controls(scene).verdict
    assert verdict[:2] == [state, "the clock of tag 7 jumped by +3600 s"]
    assert verdict[2].startswith("Synchronise the clocks")
    clock.now_s += 90.0
    scene.add_sample((1, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    assert ("clock" in controls(scene).verdict[1]) == has_position, "until the position is back"
    scene.add_pose("tag_7", Pose(4.0, 3.0, 0.0, stamp_s=clock.now_s + 4500.0, sd_m=0.1))
    clock.now_s += 4.0
    scene.add_sample((1, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    assert controls(scene).verdict[:2] == ["lost", "no position of tag 7 for 4 s"]


@pytest.mark.parametrize(
    ("silent", "expected"),
    [
        ((1, 7), [(20.0, "anchor 1 of tag 7: lost"), (30.0, "anchor 1 of tag 7: back after 10 s")]),
        ((None, 7), [(20.0, "tag 7: lost"), (30.0, "tag 7: back after 10 s")]),
    ],
)
def test_lost_anchor_and_lost_tag_are_events(silent, expected: list[tuple[float, str]]):
    incidents = Incidents()
    for tenth in range(400):
        # Anchor 4 is slow: it has data between its ranges.
        for anchor in (1, 2, 3, 4)[: 4 if tenth % 50 == 0 else 3]:
            for tag in (7, 8):
                if not (200 < tenth < 300 and tag == silent[1] and silent[0] in (None, anchor)):
                    incidents.add_range((anchor, tag), tenth / 10, tenth / 10 + 50.0)
    assert incidents.latest == expected


def test_jump_of_a_position_is_an_event_and_motion_is_not():
    incidents = Incidents()
    for tenth in range(100):
        incidents.add_position("tag 7", tenth / 10, 0.5 * tenth + (3.0 if tenth >= 60 else 0.0), 0.0)
    assert incidents.latest == [(6.0, "position of tag 7: jump by 3.5 m")]


def test_badge_has_the_age_by_reception_and_the_verdict_that_by_stamp():
    scene, clock = driven()
    scene.stamp_clock = lambda: clock.now_s + 909.6
    clock.now_s += 2.1
    page = controls(scene)
    assert page.timing[2:] == pytest.approx([2.1])
    assert "last range 11.7 s old by stamp" in page.verdict[3]


def test_control_without_effect_is_disabled():
    assert controls(Scene()).available == {"accuracy": False}
    assert controls(driven()[0]).available == {"accuracy": True}


def test_outermost_bins_are_labelled_as_such():
    assert shown(driven()[0]).document.get_model_by_name("errors").xaxis[0].major_label_overrides == {
        -1: "-1 or less",
        2: "2 or more",
    }


def test_late_positions_give_no_residuals():
    scene, clock = driven()
    for step in range(20):
        clock.now_s += 0.1
        scene.add_pose("tag_7", Pose(4.0 + step / 10, 3.0, 0.0, stamp_s=clock.now_s + 897.0, sd_m=0.1))
        scene.add_sample((1, 7), Sample(clock.now_s + 900.0, 9.0, 9.0, 0.1, Status.OK))
    assert np.isnan(scene.pairs[1, 7].columns.residual_m[-18:]).all()
    assert {row[0] for row in controls(scene).health} == {health.GOOD}


def test_history_of_the_selected_anchor_and_errors_with_standard_deviations():
    scene, _ = driven({1: 0.6})
    scene.pairs[1, 7].columns.gap_db[-1] = 9.0
    columns = scene.pairs[1, 7].columns
    for stamp_s, sequence in zip(columns.stamp_s, columns.sequence, strict=True):
        scene.set_truth((1, 7), stamp_s, sequence, 5.0)
    column = shown(scene).column
    assert column("history", "residual") == pytest.approx(0.6)
    assert (column("history", "rate")[-1], column("history", "NLOS")[-1]) == pytest.approx((10.0, 100.0))
    assert column("positions", "bound") == pytest.approx(0.2)
    shares, edges = column("distribution", "raw_share"), column("distribution", "right")
    assert shares[edges < 0.6 - 1e-9].tolist() == [0.0] * 31
    assert shares[-1] == 100.0
