"""Verdict, states of anchors, ages and counts of the viewer's page, without a browser."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bag_material import STEP_NS, corrected, record, write_corrected
from bokeh.document import Document
from browser import drawn_column

from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import Anchor
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.histories import Sample
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.page import Page
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.scene import NodeStatus, Pose, Scene
from uwb_mitigation.viewer.state import View
from uwb_mitigation.viewer.verdict import DEGRADED, GOOD, HeldVerdict, Verdict

ANCHORS = {1: (0.0, 0.0), 2: (8.0, 0.0), 3: (0.0, 6.0), 4: (8.0, 6.0)}


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def driven(
    errors_m: dict[int, float] | None = None, status: Status = Status.OK, count: int = 30, sd_m: float = 0.1
) -> tuple[Scene, Clock]:
    """Return a scene with ranges of four anchors to a tag at (4, 3), with an error for each anchor."""
    clock = Clock()
    scene = Scene(clock)
    scene.stamp_clock = lambda: clock.now_s + 900.0
    scene.set_anchors(
        [Anchor(id_, (x, y, 0.0), name="door" if id_ == 2 else "") for id_, (x, y) in ANCHORS.items()]
    )
    for _ in range(count):
        clock.now_s += 0.1
        scene.add_pose("tag_7", Pose(4.0, 3.0, 0.0, stamp_s=clock.now_s + 900.0, sd_m=sd_m))
        for anchor in ANCHORS:
            range_m = 5.0 + (errors_m or {}).get(anchor, 0.0)
            scene.add_sample((anchor, 7), Sample(clock.now_s + 900.0, range_m, range_m, 0.1, status))
    return scene, clock


def shown(scene: Scene, player: BagPlayer | None = None) -> Document:
    document = Document()
    Page(document, View(scene, threading.Lock(), player=player))
    return document


def controls(scene: Scene, player: BagPlayer | None = None):
    return shown(scene, player).get_model_by_name("controls")


def test_good_position_has_its_accuracy_age_and_share_of_corrected_ranges():
    scene, clock = driven()
    clock.now_s += 1.0
    state, reason, _, facts = controls(scene).verdict
    assert (state, reason) == ("good", "")
    assert facts.startswith(
        "sd 0.10 m, 95 % within 0.17 m \u00b7 last range 1.0 s old by stamp \u00b7 100 % of ranges corrected"
    )


def test_anchor_that_reads_long_degrades_the_position_by_its_name():
    scene, _ = driven({2: 0.6})
    state, reason, action, _ = controls(scene).verdict
    assert (state, reason) == ("degraded", "Anchor door reads 0.60 m long")
    assert action == "Calibrate, or check its position."
    document = shown(scene)
    anchors = next(
        r.data_source for r in document.get_model_by_name("map").renderers if "health" in r.data_source.data
    )
    assert anchors.data["label"] == ["1 \u2713", "door \u2297 +0.6 m", "3 \u2713", "4 \u2713"]
    assert anchors.data["health"][1] == health.BAD


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda scene, clock: setattr(clock, "now_s", clock.now_s + 12.0),
            ("lost", "no ranges of tag 7 for 12 s"),
        ),
        (lambda scene, clock: scene.tags.clear(), ("not determined", "no position of tag 7")),
        (
            lambda scene, clock: scene.set_node_status(
                "locator",
                NodeStatus(1, "", math.nan, ("tag 7 determination: circle: R. Remedy: more anchors",)),
            ),
            ("degraded", "circle: R"),
        ),
        (
            lambda scene, clock: scene.add_pose("tag_7", Pose(4, 3, 0, sd_m=0.9)),
            ("degraded", "uncertain by 0.90 m"),
        ),
        (
            lambda scene, clock: scene.add_pose("tag_7", Pose(4, 3, 0)),
            ("degraded", "its standard deviation is unknown"),
        ),
    ],
)
def test_verdict_names_the_reason(change, expected: tuple[str, str]):
    scene, clock = driven()
    change(scene, clock)
    assert tuple(controls(scene).verdict[:2]) == expected


def test_better_verdict_is_held_back_and_a_seek_is_not():
    held = HeldVerdict()
    states = [held.update(Verdict(state), now_s).state
              for state, now_s in ((DEGRADED, 0.0), (GOOD, 1.0), (DEGRADED, 1.5), (GOOD, 2.0), (GOOD, 3.0), (GOOD, 4.1),
                                   (DEGRADED, 4.2), (GOOD, 90.0))]  # fmt: skip
    assert states == [DEGRADED] * 5 + [GOOD, DEGRADED, GOOD]


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
        ({"displaced": 0.4}, "", health.BAD),
    ],
)
def test_state_of_an_anchor_needs_evidence_and_has_hysteresis(
    changes: dict[str, float], before: str, expected: str
):
    means = dict.fromkeys(("nlos", "lost", "not_ok", "residual", "stopped", "displaced"), 0.0)
    means |= {"rate": 10.0, "evidence": 100.0}
    assert health.state(means | changes, before) == expected


def test_radio_without_cirs_is_a_normal_state(tmp_path: Path):
    scene, _ = driven(status=Status.NO_CIR)
    page = controls(scene)
    assert page.verdict[0] == "good"
    assert page.verdict[3].endswith("no range corrected: no CIRs")
    assert controls(driven(status=Status.BAD_CIR)[0]).verdict[3].endswith("no range corrected")
    assert {row[0] for row in page.health} == {health.GOOD}
    cards = {title: (value, text) for title, value, text in page.cards}
    assert cards["Ranges corrected, since the start"] == ("none", "0 of 120 ranges corrected: no CIRs")
    assert "0 corrected ranges of 120" in page.summary
    bag = tmp_path / "radio.mcap"
    with BagWriter(bag, {}) as out:
        for number in range(60):
            write_corrected(out, record(number).measurement, replace(corrected(number), status=Status.NO_CIR))
    player = BagPlayer(bag, SceneUpdater(Scene(), threading.Lock()), lambda: None)
    player.index(None).join()
    marks = controls(Scene(), player).marks
    assert (marks["bad"], marks["count"]) == ([], 0)


def test_clock_jump_dead_tag_and_old_stamps_are_reported():
    scene, clock = driven()
    scene.add_sample((1, 9), Sample(clock.now_s + 888.3, 5.0, 5.0, 0.1, Status.OK))
    for _ in range(2):
        clock.now_s += 0.1
        for anchor in ANCHORS:
            scene.add_sample((anchor, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    page = controls(scene)
    assert page.incidents == [(None, "0 s ago: clock of tag 7: jump by +3600 s")]
    assert any("tag 7 are 3600.0 s in the future" in line for line in page.notice)
    assert any("tag 9 are 11.7 s old" in line for line in page.notice)
    clock.now_s += 5.0
    scene.add_sample((1, 7), Sample(clock.now_s + 4500.0, 5.0, 5.0, 0.1, Status.OK))
    page = controls(scene)
    assert "No ranges of tag 9 for 5 s." in page.notice
    assert [row[0] for row in page.tag_rows] == ["tag 7", "tag 9"]


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
    assert list(incidents.found) == expected


def test_jump_of_a_position_is_an_event_and_motion_is_not():
    incidents = Incidents()
    for tenth in range(100):
        incidents.add_position("tag 7", tenth / 10, 0.5 * tenth + (3.0 if tenth >= 60 else 0.0), 0.0)
    assert list(incidents.found) == [(6.0, "position of tag 7: jump by 3.5 m")]


def test_badge_has_the_age_by_reception_and_by_stamp():
    scene, clock = driven()
    scene.stamp_clock = lambda: clock.now_s + 909.6
    clock.now_s += 2.1
    assert controls(scene).update[2:] == pytest.approx([2.1, 11.7])


def test_controls_without_effect_are_disabled():
    available = controls(Scene()).available
    assert not any(available.values())
    assert controls(driven()[0]).available | {"accuracy": True} == available | {
        "accuracy": True, "circles": True, "heat": True, "follow": True
    }  # fmt: skip


def test_labels_of_colour_bars_and_of_the_outermost_bins_are_distinct():
    document = shown(driven()[0])
    bars = [bar for bar in document.get_model_by_name("map").right if hasattr(bar, "color_mapper")]
    steps = [f"\u2264 {limit}" for limit in ("0.1", "0.2", "0.5", "1", "10")]
    assert list(bars[1].major_label_overrides.values()) == steps
    assert document.get_model_by_name("errors").xaxis[0].major_label_overrides == {
        -1: "-1 or less",
        2: "2 or more",
    }


def test_seek_reads_few_messages_and_the_strip_shows_the_minute(tmp_path: Path):
    bag = tmp_path / "long.mcap"
    with BagWriter(bag, {}) as out:
        for number in range(9000):
            write_corrected(
                out, record(number).measurement, replace(corrected(number), range_m=5.0, range_raw_m=5.3)
            )
    scene = Scene()
    player = BagPlayer(bag, SceneUpdater(scene, threading.Lock()), lambda: None)
    player.index(None).join()
    player.seek(player.seconds)
    while player.is_behind:
        player.advance()
    assert scene.ranges <= 3001
    page = shown(scene, player)
    assert np.nanmin(drawn_column(page, "strip", "age")) == pytest.approx(-60.0, abs=60.0 * STEP_NS / 1e7)
    assert np.ptp(drawn_column(page, "history", "age")) == pytest.approx(player.seconds, abs=1.0)


def test_late_positions_give_no_residuals():
    scene, clock = driven()
    for step in range(20):
        clock.now_s += 0.1
        scene.add_pose("tag_7", Pose(4.0 + step / 10, 3.0, 0.0, stamp_s=clock.now_s + 897.0, sd_m=0.1))
        scene.add_sample((1, 7), Sample(clock.now_s + 900.0, 9.0, 9.0, 0.1, Status.OK))
    assert np.isnan([sample.residual_m for sample in list(scene.pairs[1, 7].samples)[-18:]]).all()
    assert {row[0] for row in controls(scene).health} == {health.GOOD}


def test_history_of_the_selected_anchor_and_errors_with_standard_deviations():
    scene, _ = driven({1: 0.6})
    scene.pairs[1, 7].samples[-1].gap_db = 9.0
    for sample in scene.pairs[1, 7].samples:
        sample.true_m = 5.0
        scene.count_error(sample)
    column = partial(drawn_column, shown(scene))
    assert column("history", "residual") == pytest.approx(0.6)
    assert (column("history", "rate")[-1], column("history", "NLOS")[-1]) == pytest.approx((10.0, 100.0))
    assert column("positions", "bound") == pytest.approx(0.2)
    shares, edges = column("distribution", "raw_share"), column("distribution", "right")
    assert shares[edges < 0.6 - 1e-9].tolist() == [0.0] * 31
    assert shares[-1] == 100.0
