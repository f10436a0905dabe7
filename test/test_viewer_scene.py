"""Data of the viewer's page: rates, losses, clocks, positions from raw ranges, colours. Without a page."""

import math

import numpy as np
import pytest
from drawn import Clock, Drawn

from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import Cir, Encoding, Status
from uwb_mitigation.viewer.headline import cards
from uwb_mitigation.viewer.histories import Pose, Sample, plausible_cir
from uwb_mitigation.viewer.palette import NIGHT, PAPER, STATUS_LOOKS, TRACK_STYLES, TrackKind
from uwb_mitigation.viewer.scene import MAX_PAIRS, Scene
from uwb_mitigation.viewer.state import View


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def view(clock: Clock) -> View:
    return View(Scene(clock))


def test_slow_pair_has_data_between_its_ranges(view: View, clock: Clock) -> None:
    for clock.now_s in range(0, 100, 5):
        view.scene.add_sample((1, 7), Sample(clock.now_s, 5.3, 5.1, 0.1, Status.OK))
    clock.now_s += 9.0
    page = Drawn(view)
    assert page.column("pairs", "status") == ["OK"]
    assert page.column("pairs", "rate") == pytest.approx([0.2])


def test_update_waits_until_the_page_has_drawn_the_last_one(view: View) -> None:
    """Otherwise updates for a slow page would queue, and it would show old data."""
    drawn = Drawn(view)
    view.scene.add_sample((1, 7), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
    drawn.page.tick()
    assert drawn.controls.timing[0] == 1
    drawn.controls.acknowledged = 1
    drawn.page.tick()
    assert drawn.controls.timing[0] == 2
    assert drawn.column("strip", "corrected") == pytest.approx([5.1])


def test_ranges_of_a_stopped_pair_age_and_disappear(view: View, clock: Clock) -> None:
    def received(anchor: int, time_s: float) -> None:
        clock.now_s = time_s
        view.scene.add_sample((anchor, 7), Sample(time_s, 5.3, 5.1, 0.1, Status.OK))

    received(1, 1000.0)
    received(1, 1020.0)
    page = Drawn(view)
    assert page.column("strip", "age").tolist() == [-20.0, 0.0]
    received(2, 1050.0)
    page.send("draw")
    assert page.column("strip", "age").tolist() == [-50.0, -30.0]
    received(2, 1070.0)
    page.send("draw")
    assert page.column("strip", "age").tolist() == [-50.0]


@pytest.mark.parametrize(("is_whole", "first"), [(False, 100), (True, 0)])
def test_a_stream_keeps_the_latest_pairs_and_a_recording_all(is_whole: bool, first: int) -> None:
    scene = Scene(is_whole=is_whole)
    for anchor in range(MAX_PAIRS + 100):
        scene.add_sample((anchor, 7), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
    assert {anchor for anchor, _ in scene.pairs} == set(range(first, MAX_PAIRS + 100))


def test_ranges_with_equal_stamps_have_their_own_truths() -> None:
    scene = Scene()
    for sequence in range(20):
        scene.add_sample((1, 7), Sample(1000.0, 5.0, 5.0, 0.1, Status.OK, sequence=sequence))
        scene.set_truth((1, 7), 1000.0, sequence, 5.0 + sequence)
    assert scene.errors == 20
    assert scene.pairs[1, 7].columns.true_m.tolist() == [5.0 + sequence for sequence in range(20)]


def test_pair_without_ranges_before_the_position_does_not_change_the_order() -> None:
    whole = Scene(is_whole=True)
    received_s = {2: 69.0, 3: 70.0, 1: 9.0}
    for anchor, time_s in received_s.items():
        whole.clock = lambda time_s=time_s: time_s
        whole.add_sample((anchor, 7), Sample(1000.0 + time_s, 5.0, 5.0, 0.1, Status.OK))
    scene = Scene()
    scene.show(whole, 69.5)
    assert list(scene.pairs) == [(1, 7), (2, 7)]
    assert (scene.received_s, scene.latest_stamp_s(7)) == (69.0, 1069.0)


def test_ranges_that_the_viewer_drops_change_neither_rate_nor_losses() -> None:
    scene = Scene()
    for number in range(40):
        if number in range(30, 36):
            scene.count_dropped(1)
            continue
        scene.add_sample((1, 7), Sample(1000.0 + number / 10, 5.3, 5.1, 0.1, Status.OK, sequence=number))
    history = scene.pairs[1, 7]
    assert (history.rate_hz(), history.statistics()["lost"]) == (pytest.approx(10.0), 0)
    assert history.rate_hz(age_s=2.0) < 8.0
    scene.count_dropped(1)
    assert history.rate_hz(age_s=2.0) == pytest.approx(10.0)


def test_rate_is_that_of_the_latest_known_intervals_while_the_viewer_drops_most() -> None:
    scene, stamp_s = Scene(), 1000.0
    for number in range(60):
        stamp_s += 0.1 if number % 2 else 0.3
        if number >= 40 and number % 10:
            scene.count_dropped(1)
        scene.add_sample((1, 7), Sample(stamp_s, 5.3, 5.1, 0.1, Status.OK))
    assert scene.pairs[1, 7].rate_hz() == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize(("busy_s", "end_s"), [(15, 20), (60, 25)])
def test_pair_without_ranges_is_silent_later_while_the_viewer_drops_some(
    busy_s: int, end_s: int, clock: Clock
) -> None:
    scene = Scene(clock)
    for number in range(10 * end_s):
        clock.now_s = number / 10
        # Anchor 2 stops after 10 s. Until `busy_s`, the viewer drops nine ranges in ten.
        if number < 10 * busy_s and number % 10:
            scene.count_dropped(1)
            continue
        for anchor in (1, 2) if number < 100 else (1,):
            scene.add_sample((anchor, 7), Sample(1000.0 + clock.now_s, 5.3, 5.1, 0.1, Status.OK))
        if number == 150:
            assert {scene.no_data(history) for history in scene.pairs.values()} == {""}
    assert scene.no_data(scene.pairs[2, 7]) == f"no data for {end_s - 9.1:.0f} s"
    assert scene.no_data(scene.pairs[1, 7]) == ""


def test_share_of_lost_ranges_is_that_of_the_radio_although_the_viewer_drops_half() -> None:
    rng, scene = np.random.default_rng(1), Scene()
    for number in range(30 * 400):
        # The radio loses one in ten; each second, the viewer drops those of half a second. The next one arrives late.
        late_s = 0.6 if number % 200 == 100 else 0.0
        if rng.random() < 0.1:
            continue
        if number % 200 < 100:
            scene.count_dropped(1)
        else:
            sequence = number - round(200 * late_s)
            sample = Sample(1000.0 + number / 200 - late_s, 5.3, 5.1, 0.1, Status.OK, sequence=sequence)
            scene.add_sample((sequence % 30, 7), sample)
    lost = [history.statistics()["lost"] for history in scene.pairs.values()]
    assert np.mean(lost) == pytest.approx(10.0, abs=1.0)


def test_outages_are_those_of_all_tags_and_losses_need_sequence_numbers() -> None:
    scene = Scene()
    for number in range(70 * 60):
        if number % 350 < 70:
            scene.count_dropped(1)
        else:
            sample = Sample(1000.0 + number / 700, 5.3, 5.1, 0.1, Status.OK, sequence=number // 70)
            scene.add_sample((1, number % 70), sample)
    assert {history.statistics()["lost"] for history in scene.pairs.values()} == {0.0}
    scene = Scene()
    for number in range(9):
        scene.add_sample((1, 7), Sample(1000.0 + number, 5.3, 5.1, 0.1, Status.OK, sequence=0))
    assert math.isnan(scene.pairs[1, 7].statistics()["lost"])


def test_rates_depend_on_stamps_and_not_on_when_they_are_read(view: View, clock: Clock) -> None:
    for step in range(60):
        # The page is drawn while the viewer is 2 s behind.
        clock.now_s = 2.0 * (step == 59)
        for anchor in (1, 2) if step < 50 else (2,):
            view.scene.add_sample((anchor, 7), Sample(1000.0 + step / 10, 5.3, 5.1, 0.1, Status.OK))
    assert sorted(Drawn(view).column("pairs", "rate")) == pytest.approx([20 / 2.9, 10.0]), (
        "the pair of anchor 1 has no range for 1 s"
    )


def test_clocks_may_differ_and_jump_back() -> None:
    scene = Scene()
    for step in range(50):
        for anchor, late_s in ((1, 0.0), (2, 5.0)):
            scene.add_sample((anchor, 7), Sample(1000.0 + step / 10 - late_s, 5.3, 5.1, 0.1, Status.OK))
    assert [history.rate_hz() for _, history, _ in scene.latest()] == pytest.approx([10.0, 10.0])
    scene.add_sample((3, 7), Sample(9e8, 5.3, 5.1, 0.1, Status.OK))
    scene.add_sample((1, 7), Sample(1005.0, 5.3, 5.1, 0.1, Status.OK))
    assert [pair for pair, _, _ in scene.latest()] == [(1, 7)], "a stamp of the future hides nothing for long"
    scene.add_sample((1, 7), Sample(1001.0, 5.3, 5.1, 0.1, Status.OK))
    assert len(scene.pairs[1, 7].rows) == 1, "a replay starts again"
    scene = Scene()
    for step in range(100):
        for tag, clock_s in ((7, 1000.0), (8, 4600.0)):
            scene.add_sample((1, tag), Sample(clock_s + step / 10, 5.3, 5.1, 0.1, Status.OK))
    assert [len(scene.pairs[1, tag].rows) for tag in (7, 8)] == [100, 100]


def test_raw_positions_are_those_of_the_locator_on_raw_ranges() -> None:
    scene = Scene()
    anchors = {1: (0.0, 0.0), 2: (8.0, 0.0), 3: (0.0, 6.0), 4: (8.0, 6.0)}
    scene.set_anchors([Anchor(key, (*place, 0.0)) for key, place in anchors.items()])
    estimator = TagEstimator(
        EstimatorConfig(AnchorMap([Anchor(key, (*place, 0.0)) for key, place in anchors.items()]))
    )
    expected = {}
    for step in range(120):
        row, time_s = step % 4, 1000.0 + step / 40.0
        scene.add_pose("tag", Pose(4.0, 3.0, 0.0, stamp_s=time_s))
        estimator.add(TagHeight(0.0, 0.01))
        x, y = anchors[row + 1]
        raw_m = math.hypot(5.0 - x, 2.0 - y) + (0.5 if row == 2 else 0.0)
        scene.add_sample((row + 1, 7), Sample(time_s, raw_m, 5.5, 0.1, Status.OK))
        if (estimate := estimator.add(TagRange(round(time_s * 1e9), row, raw_m))) is not None:
            expected[time_s] = estimate.position
    for *position, stamp_s in scene.tracks["tag", TrackKind.RAW].rows[:, [0, 1, 2, 7]].tolist():
        assert position == pytest.approx(expected[stamp_s], abs=1e-6)
    assert position[:2] == pytest.approx((5.0, 2.0), abs=0.3)
    assert scene.pairs[2, 7].columns.residual_m[-1] == pytest.approx(0.5)


def test_hostile_positions_do_not_stop_the_stream() -> None:
    """Positions of a topic may have any value; raw positions are estimated from them."""
    rng = np.random.default_rng(1)
    values = (0.0, 1.0, -3.0, 8.0, 1e-300, 1e5, -2e7, 1e17, 1e300, math.inf, math.nan)
    for case in range(40):
        # More anchors than an estimator accepts.
        places = [
            Anchor(1 + n, tuple(rng.choice(values, 3).tolist())) for n in range(300 if case == 0 else 5)
        ]
        places += [
            Anchor(10_000 + n, (8.0 * (n % 2), 6.0 * (n // 2), float(rng.choice(values)))) for n in range(4)
        ]
        scene = Scene(Clock())
        scene.set_anchors(places)
        for step in range(60):
            stamp_s = 1000.0 + step / 40.0
            scene.add_pose("tag", Pose(4.0, 3.0, float(rng.choice(values)), stamp_s=stamp_s))
            anchor = places[step % len(places)].id
            range_m = float(rng.choice((*values, 4.0, 5.0, 5.0, 5.0)))
            scene.add_sample((anchor, 7), Sample(stamp_s, range_m, 5.0, 0.1, Status.OK))
        for track in scene.tracks.values():
            assert np.isfinite(track.rows[:, :2]).all()


def contrast(first: str, second: str) -> float:
    """Contrast of two colours as WCAG 2.1 defines it."""
    levels = []
    for colour in (first, second):
        rgb = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
        levels.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])
    return (max(levels) + 0.05) / (min(levels) + 0.05)


def test_statuses_and_tracks_are_distinct_and_have_the_contrast_of_aa() -> None:
    looks = list(STATUS_LOOKS.values())
    assert len(looks) == len(Status)
    for part in zip(*looks, strict=True):
        assert len(set(part)) == len(Status)
    for colour in {look.colour for look in looks} | {style[0] for style in TRACK_STYLES.values()} - {NIGHT}:
        for paper in (PAPER, NIGHT) if colour else ():
            assert contrast(colour, paper) >= 3.0, (colour, paper)
    assert contrast(PAPER, NIGHT) >= 4.5


def test_figures_are_those_of_the_selected_tag() -> None:
    scene = Scene(Clock())
    for tag, name, error_m in ((7, "tag", 0.1), (9, "tag_9", 0.5)):
        scene.add_sample((1, tag), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
        for step in range(20):
            time_s = 1000.0 + step / 10
            scene.add_pose(f"tag_{tag}", Pose(step / 10, 0.0, 0.0, stamp_s=time_s), TrackKind.TRUE)
            scene.add_pose(name, Pose(step / 10, error_m, 0.0, stamp_s=time_s, sd_m=0.2))
    for tag, expected in ((7, "0.100 m"), (9, "0.500 m")):
        assert cards(View(scene), tag)[0] == ["Position RMSE, last 60 s", expected, ""]
    scene.add_sample((1, 5), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
    for tag in (5, 7):
        assert [card[0] for card in cards(View(scene), tag)] == ["Ranges corrected, since the start"], (
            "ambiguous"
        )


@pytest.mark.parametrize(
    ("scale", "first_path", "count"),
    [(3e38, math.nan, 200), (math.nan, math.nan, 200), (1.0, 1e30, 200), (1.0, -3.4e38, 200), (1.0, math.nan, 2033),
     (1.0, math.nan, 0)],
)  # fmt: skip
def test_implausible_cir_is_not_shown(scale: float, first_path: float, count: int) -> None:
    cir = Cir(np.full(count, 30_000, np.int16), Encoding.MAGNITUDE, 730, first_path, scale=scale)
    assert plausible_cir(cir) is None
