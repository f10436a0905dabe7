"""The viewer's page in a real browser, on a scene that the test fills."""

from __future__ import annotations

import base64
import gzip
import io
import math
import re
import socket
import time
from collections.abc import Iterator
from functools import partial
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from threading import Lock
from types import SimpleNamespace

import numpy as np
import pytest
from bokeh.document import Document
from browser import Browser, drawn_column
from PIL import Image

from benchmarks.equipment.page_clients import PageClients
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import Cir, Encoding, Status
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.floor_plan import load_floor_plan
from uwb_mitigation.viewer.headline import live_cards
from uwb_mitigation.viewer.histories import Sample, Trace
from uwb_mitigation.viewer.page import Page
from uwb_mitigation.viewer.palette import NIGHT, PAPER, STATUS_LOOKS, TRACK_COLOURS, TrackKind
from uwb_mitigation.viewer.scene import MAX_PAIRS, NodeStatus, Pose, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

HOSTILE = "<img src=x onerror=window.pwned=1><script>window.pwned=1</script>$$x$$"


class Clock:
    """A clock that changes only when a test sets it."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def view(clock: Clock) -> View:
    return View(Scene(clock), Lock(), "UWB ranges")


@pytest.fixture
def server(view: View) -> Iterator[ViewerServer]:
    with ViewerServer(view, port=0) as server:
        yield server


def fill_scene(view: View, upto_s: float = 5.0) -> None:
    """Two pairs of tag 7 at 10 Hz each; the ranges of anchor 2 are out of distribution and 0.5 m too long."""
    scene = view.scene
    with view.lock:
        scene.set_anchors([Anchor(1, (0, 0, 2), name=HOSTILE), Anchor(2, (8, 0, 2))])
        scene.set_node_status(HOSTILE, NodeStatus(1, HOSTILE))
        for step in range(int(upto_s * 10)):
            time_s = 1000.0 + step / 10
            for anchor in (1, 2):
                magnitude = np.full(200, 10, np.int16)
                magnitude[20:40] = 1000 * anchor
                cir = Cir(magnitude, Encoding.MAGNITUDE, 730, 750.4, noise_threshold=120)
                scene.add_trace((anchor, 7), Trace(cir))
                status = Status.OK if anchor == 1 else Status.OUT_OF_DISTRIBUTION
                sample = Sample(
                    time_s, 5.3, 5.1 if anchor == 1 else 5.3, 0.1, status, 4.8 if anchor == 2 else 5.1
                )
                scene.add_sample((anchor, 7), sample)
                scene.count_error(sample)
            scene.add_position(HOSTILE, TrackKind.TRUE, (time_s, 4.0, 3.0, 1.0, math.nan))
            scene.add_pose("tag", Pose(4 + math.sin(step / 20), 3, 1, (0.4, 0.2, 0.3), stamp_s=time_s))


def empty_figures(browser: Browser) -> dict[str, str]:
    """Return the messages in figures without data, {figure: message}."""
    return browser.run(
        "return Object.fromEntries([...document.querySelectorAll('[data-empty]')].map((e) => [e.id, e.dataset.empty]))"
    )


def open_page(browser: Browser, server: ViewerServer, width: int = 1280, height: int = 1150) -> None:
    browser.open(server.url, width, height)
    browser.wait("the page", browser.ready)


def test_page_shows_the_scene_with_hostile_names_as_text(
    browser: Browser, view: View, server: ViewerServer
) -> None:
    fill_scene(view)
    open_page(browser, server)
    assert browser.column("pairs", "anchor") == ["1", "2"]
    assert browser.column("pairs", "corrected") == pytest.approx([5.1, 5.3])
    assert browser.column("pairs", "rate") == pytest.approx([10.0, 10.0])
    assert browser.column("pairs", "status") == ["OK", "OUT_OF_DISTRIBUTION"]
    assert max(browser.column("cir", "magnitude")) == 1000.0
    assert sum(browser.column("errors", "raw")) == 100
    assert len(browser.column("strip", "raw")) == 50
    assert browser.column("map", "corrected") == pytest.approx([math.sqrt(5.1**2 - 1), math.sqrt(5.3**2 - 1)])
    assert browser.cards()["Mean absolute range error, since the start"] == ("0.250 m", "raw: 0.350 m")
    browser.wait("the hostile name as text", lambda: HOSTILE in browser.text())
    assert browser.run("return window.pwned ?? null") is None
    assert browser.console_messages() == []


def test_pairs_tags_and_nodes_without_data_are_grey(
    browser: Browser, view: View, server: ViewerServer, clock: Clock
) -> None:
    fill_scene(view)
    entries = [
        SimpleNamespace(key=f"tag {n} determination", value=f"{state}: R")
        for n, state in ((7, "circle"), (8, "unique"))
    ]
    diagnosis = SimpleNamespace(status=[SimpleNamespace(name="locator", level=1, message="", values=entries)])
    with view.lock:
        view.scene.set_node_status("driver", NodeStatus(0, "10.0 Hz", clock()))
        view.scene.set_node_status("recording", NodeStatus(2, "damaged"))
    SceneUpdater(view.scene, view.lock).add("/diagnostics", diagnosis)
    open_page(browser, server)
    assert "10.0 Hz" in browser.text()
    assert "tag 7 determination: circle: R" in browser.run(
        "return document.getElementById('notice').innerText"
    )
    assert "STALE" not in browser.text()
    assert browser.column("pairs", "no_data") == [False, False]
    clock.now_s = 12.0
    browser.wait("no data", lambda: browser.column("pairs", "status") == ["no data for 12 s"] * 2)
    assert browser.column("pairs", "rate") == [0.0, 0.0]
    browser.wait("the row", lambda: "no data" in browser.table("Pairs")[0]["status"])
    assert browser.column("map", "name")[-1] == "tag 7: no data for 12 s"
    assert browser.column("map", "corrected") == []
    assert "STALE" in browser.text()
    assert "no diagnostics for 12 s; last: 10.0 Hz" in browser.text()
    assert "damaged" in browser.text(), "it is not of a node"
    assert "No ranges for 12 s." in browser.text()
    assert "circle: R" not in browser.text()
    assert browser.cards()["Position error, now"] == ("-", "no position of tag 7 in the last 3 s")
    browser.wait(
        "the state of the page", lambda: "NO RANGES" in browser.text() and "LIVE" not in browser.text()
    )
    browser.screenshot("viewer_no_data")
    with view.lock:
        view.scene.add_sample((1, 7), Sample(1017.0, 5.3, 5.1, 0.1, Status.OK))
    browser.wait("data", lambda: browser.column("pairs", "status")[0] == "OK")
    assert "No ranges for 12 s." not in browser.text()


def test_slow_pair_has_data_between_its_ranges(view: View, clock: Clock) -> None:
    for clock.now_s in range(0, 100, 5):
        view.scene.add_sample((1, 7), Sample(clock.now_s, 5.3, 5.1, 0.1, Status.OK))
    clock.now_s += 9.0
    document = Document()
    Page(document, view)
    source = document.get_model_by_name("pairs")
    assert source.data["status"] == ["OK"]
    assert source.data["rate"] == pytest.approx([0.2])


def test_map_view_is_fixed_until_changed(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    open_page(browser, server)

    def view_of_map() -> list[float]:
        return browser.run(
            "const {x_range: x, y_range: y} = Bokeh.documents[0].get_model_by_name('map');"
            "return [x.start, x.end, y.start, y.end]"
        )

    def settled() -> list[float] | None:
        """Return the view after the final layout of the page."""
        seen = view_of_map()
        for _ in range(4):
            time.sleep(0.5)
            if view_of_map() != seen:
                return None
        return seen

    first = browser.wait("a view", settled)
    assert first[0] < 0 < 8 < first[1], "both anchors"

    def moved(x: float) -> None:
        with view.lock:
            view.scene.add_pose("tag", Pose(x, 3, 0))
            view.scene.add_sample((1, 7), Sample(1005.0, x, x, 0.1, Status.OK))
        browser.wait("the tag", lambda: browser.column("map", "name") and x in browser.column("map", "x1"))

    moved(50.0)
    assert view_of_map() == first
    browser.run("Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('map')).reset()")
    browser.wait("everything", lambda: view_of_map()[1] > 50)
    zoomed = [1.0, 2.0, 3.0, 4.0]
    browser.run(
        "const [a, b, c, d] = arguments[0], plot = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('map'));"
        "plot.update_range({xrs: new Map([[plot.model.x_range, {start: a, end: b}]]),"
        " yrs: new Map([[plot.model.y_range, {start: c, end: d}]])}, {panning: true})",
        zoomed,
    )
    moved(90.0)
    with view.lock:
        view.scene.set_anchors([Anchor(5, (-70, 0, 2))])
    browser.wait("the new anchor", lambda: "5" in browser.column("map", "id"))
    assert view_of_map() == zoomed
    with view.lock:
        view.scene.add_pose("tag", Pose(1.5, 3.98, 0))
    browser.wait("its name below the tag, in the frame", lambda: max(browser.column("map", "offset")) > 0)


def test_page_can_be_paused_and_resumed(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    open_page(browser, server)
    browser.click("button", "Pause")
    # Wait for the server.
    browser.wait("the button", lambda: browser.find("button", "Resume"))
    still = browser.driver.current_window_handle
    browser.driver.switch_to.new_window("tab")
    open_page(browser, server)

    def shown(value: float) -> bool:
        return browser.column("pairs", "corrected")[0] == pytest.approx(value)

    for value in (9.5, 9.6):
        with view.lock:
            view.scene.add_sample((1, 7), Sample(1010.0, 9.9, value, 0.1, Status.OK))
        browser.wait("the other page", partial(shown, value))
    browser.driver.close()
    browser.driver.switch_to.window(still)
    assert shown(5.1)
    assert "PAUSED" in browser.text()
    browser.driver.find_element("css selector", "body").send_keys(" ")
    browser.wait("the new range", partial(shown, 9.6))


def test_row_updated_during_a_click_is_selected(browser: Browser, view: View, server: ViewerServer) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    fill_scene(view)
    open_page(browser, server)
    row = browser.wait("the row", lambda: browser.find("button", "Select anchor 2, tag 7"))
    ActionChains(browser.driver).click_and_hold(row).perform()
    with view.lock:
        view.scene.add_sample((2, 7), Sample(1005.0, 9.9, 9.5, 0.1, Status.OUT_OF_DISTRIBUTION))
    browser.wait("the new range", lambda: browser.column("pairs", "corrected")[1] == pytest.approx(9.5))
    ActionChains(browser.driver).release().perform()
    browser.wait("the other CIR", lambda: max(browser.column("cir", "magnitude")) == 2000.0)
    browser.wait("it in the table", lambda: browser.table("Pairs")[1]["corrected, m"] == "9.500")


def test_waterfall_has_the_newest_cir_at_the_top(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view, upto_s=0.5)
    open_page(browser, server)
    colours = browser.run(
        "const plot = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name('waterfall'));"
        "const canvas = plot.export('png', false).canvas.getContext('2d'), {x_scale, y_scale} = plot.frame;"
        "return [2, 40].map((ago) => Array.from(canvas.getImageData(x_scale.compute(10), y_scale.compute(ago), 1, 1).data))"
    )
    none, peak = [0, 32, 76, 255], [255, 233, 69, 255]
    assert colours == [peak, none]


def test_implausible_values_do_not_break_the_page(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    nan, inf = math.nan, math.inf
    with view.lock:
        view.scene.set_anchors([Anchor(1, (0, 0, 2)), Anchor(2, (8, 0, nan)), Anchor(3, (0, 1e300, nan))])
        for pair, values in (
            ((1, 7), (3e38, -3e38, inf)),
            ((2, 7), (nan, nan, nan)),
            ((3, 7), (inf, -inf, 0.1)),
        ):
            view.scene.add_sample(pair, Sample(1005.0, *values, Status.BAD_CIR, 3e38))
            view.scene.count_error(Sample(1005.0, *values, Status.BAD_CIR, 5.0))
            for scale, first_path, count in (
                (3e38, nan, 200),
                (nan, nan, 200),
                (1.0, 1e30, 200),
                (1.0, -3.4e38, 200),
                (1.0, nan, 2033),
            ):
                cir = Cir(np.full(count, 30_000, np.int16), Encoding.MAGNITUDE, 730, first_path, scale=scale)
                assert Trace.from_cir(cir) is None
        view.scene.add_pose("tag", Pose(4, 3, nan, (1e300, nan, nan)))
        view.scene.add_pose("tag", Pose(1e300, 3, 0))
        view.scene.add_position("tag", TrackKind.TRUE, (1005.0, 4.0, -1e300, 0.0, math.nan))
    open_page(browser, server)
    assert browser.console_messages() == []
    shown = [cell for row in browser.table("Pairs") for cell in row.values() if "e+" in cell]
    assert shown == ["3.0e+38", "-3.0e+38"]
    assert browser.column("map", "corrected") == []
    ends = browser.run(
        "return ['strip', 'map'].flatMap((name) => ['x_range', 'y_range'].flatMap((range) => {"
        "  const {start, end} = Bokeh.documents[0].get_model_by_name(name)[range]; return [start, end]}))"
    )
    assert max(map(abs, ends)) < 100
    assert browser.cards()["Mean absolute range error, since the start"][0] == "0.250 m"


def test_ranges_of_a_stopped_pair_age_and_disappear(view: View, clock: Clock) -> None:
    def received(anchor: int, time_s: float) -> None:
        clock.now_s = time_s
        view.scene.add_sample((anchor, 7), Sample(time_s, 5.3, 5.1, 0.1, Status.OK))

    received(1, 1000.0)
    received(1, 1020.0)
    document = Document()
    page = Page(document, view)
    assert drawn_column(document, "strip", "age").tolist() == [-20.0, 0.0]
    received(2, 1050.0)
    page.draw()
    assert drawn_column(document, "strip", "age").tolist() == [-50.0, -30.0]
    received(2, 1070.0)
    page.draw()
    assert drawn_column(document, "strip", "age").tolist() == [-50.0]


def test_only_the_latest_pairs_are_kept() -> None:
    scene = Scene()
    for anchor in range(MAX_PAIRS + 100):
        scene.add_sample((anchor, 7), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
    assert {anchor for anchor, _ in scene.pairs} == set(range(100, MAX_PAIRS + 100))


def test_ranges_that_the_viewer_drops_change_neither_rate_nor_losses() -> None:
    scene = Scene()
    for number in range(40):
        if number in range(30, 36):
            scene.count_dropped(1)
            continue
        scene.add_sample((1, 7), Sample(1000.0 + number / 10, 5.3, 5.1, 0.1, Status.OK))
        scene.pairs[1, 7].count_lost(number)
    assert scene.pairs[1, 7].rate_hz() == pytest.approx(10.0)
    assert scene.pairs[1, 7].lost == 0


def test_rates_depend_on_stamps_and_not_on_when_they_are_read(view: View, clock: Clock) -> None:
    for step in range(60):
        # The page is drawn while the viewer is 2 s behind.
        clock.now_s = 2.0 * (step == 59)
        for anchor in (1, 2) if step < 50 else (2,):
            view.scene.add_sample((anchor, 7), Sample(1000.0 + step / 10, 5.3, 5.1, 0.1, Status.OK))
    document = Document()
    Page(document, view)
    rates = document.get_model_by_name("pairs").data["rate"]
    assert sorted(rates) == pytest.approx([20 / 2.9, 10.0]), "the pair of anchor 1 has no range for 1 s"


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
    assert len(scene.pairs[1, 7].samples) == 1, "a replay starts again"
    scene = Scene()
    for step in range(100):
        for tag, clock_s in ((7, 1000.0), (8, 4600.0)):
            scene.add_sample((1, tag), Sample(clock_s + step / 10, 5.3, 5.1, 0.1, Status.OK))
    assert [len(scene.pairs[1, tag].samples) for tag in (7, 8)] == [100, 100]


def fetch(server: ViewerServer, path: str = "", **headers: str) -> HTTPResponse:
    client = HTTPConnection("127.0.0.1", server.port, timeout=60)
    client.request("GET", f"/{path}", headers=headers)
    response = client.getresponse()
    response.body = response.read()
    client.close()
    return response


@pytest.mark.parametrize("path", ["", "ws", "static/js/bokeh.min.js"])
def test_unknown_host_is_refused(view: View, server: ViewerServer, path: str) -> None:
    for own in ("localhost", "LocalHost", "127.0.0.1"):
        assert fetch(server, path, Host=f"{own}:{server.port}").status != 403
    for name in ("evil.example", f"evil.example:{server.port}", "localhost", f"localhost:{server.port + 1}"):
        assert fetch(server, path, Host=name).status == 403
    assert view.pages == 0 or path == ""
    with ViewerServer(view, port=0, origins=("robot.local:5006",)) as other:
        assert fetch(other, Host="robot.local:5006").status == 200


def test_content_security_policy_blocks_scripts(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    policies = [
        fetch(server, path, Host=f"localhost:{server.port}", **{"X-Nonce": "mine"}).headers[
            "Content-Security-Policy"
        ]
        for path in ("", "", "static/js/bokeh.min.js", "absent")
    ]
    assert len(set(policies)) == 4, "a nonce is used once"
    for policy in policies:
        (scripts,) = [part for part in policy.split("; ") if part.startswith("script-src")]
        assert "unsafe" not in scripts
        assert "mine" not in scripts
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy
    open_page(browser, server)
    assert browser.console_messages() == []
    browser.run(
        "const script = document.createElement('script');"
        "script.textContent = 'window.pwned = 1'; document.body.append(script);"
        "const image = document.createElement('div'); document.body.append(image);"
        "image.innerHTML = '<img src=x: onerror=\"window.pwned = 2\">'"
    )
    browser.wait("the refusal", lambda: "Content Security Policy" in "".join(browser.console_messages()))
    assert browser.run("return window.pwned ?? null") is None


def test_swipe_over_a_figure_scrolls_a_phone(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    with browser.touch_screen():
        open_page(browser, server, 400, 800)
        for name in ("map", "cir", "strip", "waterfall", "errors"):
            before = browser.scroll_to(name)
            browser.swipe(200, 400, 250 if before < 500 else -250)
            browser.wait(
                f"the page to scroll by {name}",
                lambda before=before: abs(browser.run("return scrollY") - before) > 100,
            )
        assert browser.console_messages() == []


def test_content_fits_the_screen(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    with view.lock:
        view.scene.add_sample(
            (0xDECA010203040506, 0xDECA0102030407F8), Sample(1005.0, -9.9, 123.456, 12.345, Status.OK)
        )
    open_page(browser, server, 1280, 2000)
    browser.wait("the table", lambda: len(browser.table("Pairs")) == 3)
    assert "scroll the table sideways" not in browser.text()
    for width in (1280, 1024, 400):
        # Figures change their width asynchronously.
        browser.wait(f"everything within {width} pixels", lambda width=width: not browser.cut_off(width))
        assert browser.run("return document.querySelector('header').clientHeight") <= 60


def test_session_of_a_left_page_is_discarded(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    open_page(browser, server)
    assert view.pages == 1
    browser.open("about:blank")
    browser.wait("it to be forgotten", lambda: view.pages == 0)
    browser.driver.back()
    browser.wait("it to be there again", lambda: view.pages == 1 and browser.ready())


def test_wildcard_address_accepts_addresses_of_this_machine(view: View) -> None:
    with ViewerServer(view, "0.0.0.0", 0) as server, PageClients(server.url, 1):
        assert server.url == f"http://localhost:{server.port}/"
        assert view.pages == 1
        for name in (socket.gethostname(), "127.0.0.1"):
            assert fetch(server, Host=f"{name}:{server.port}").status == 200
        for name in ("203.0.113.7", "evil.example"):
            assert fetch(server, Host=f"{name}:{server.port}").status == 403


def test_unusable_address_is_refused(server: ViewerServer, view: View) -> None:
    with pytest.raises(ParameterError, match="an address of this machine"):
        ViewerServer(view, "203.0.113.7", 0)
    with pytest.raises(ParameterError, match=str(server.port)):
        ViewerServer(view, port=server.port)


def test_pairs_can_be_sorted_and_selected(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    open_page(browser, server)

    def anchors() -> list[str]:
        return [row["anchor, tag"] for row in browser.table("Pairs")]

    browser.wait("the rows", lambda: anchors() == ["1, 7", "2, 7"])
    first = browser.table("Pairs")[0]
    values = [
        first[name]
        for name in ("corrected, m", "raw, m", "correction, m", "not OK, %", "rate, Hz", "lost, %")
    ]
    assert values == ["5.100", "5.300", "0.200", "0", "10.0", "0"]
    browser.click("button", "correction, m")
    browser.wait("the smallest correction first", lambda: anchors() == ["2, 7", "1, 7"])
    assert browser.find("columnheader", "correction, m").get_attribute("aria-sort") == "ascending"
    browser.find("searchbox", "search").send_keys("1,")
    browser.wait("one row", lambda: anchors() == ["1, 7"])
    browser.find("searchbox", "search").clear()
    browser.find("combobox", "show").send_keys("not OK")
    browser.wait("the bad pair", lambda: anchors() == ["2, 7"])
    browser.find("button", "Select anchor 2, tag 7").send_keys("\ue007")
    title = "Last CIR: anchor {}, tag 7"
    browser.wait("its CIR", lambda: browser.find("heading", title.format(2)))
    pressed = browser.find("button", "Select anchor 2, tag 7").get_attribute("aria-pressed")
    assert pressed == "true"
    browser.wait("it in the URL", lambda: "#anchor=2&tag=7" in browser.driver.current_url)
    with view.lock:
        view.scene.add_sample((3, 7), Sample(1005.0, 5.3, 5.3, 0.1, Status.NO_CIR))
    browser.wait("the other pair", lambda: anchors() == ["2, 7", "3, 7"])
    browser.click("button", "Select anchor 3, tag 7")
    browser.wait("the title", lambda: browser.find("heading", title.format(3)))
    browser.wait("the reason", lambda: empty_figures(browser)["cir"] == "No CIR of this pair yet.")


def test_map_shows_and_exports_tracks_and_rays(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    with view.lock:
        view.scene.add_pose("tag", Pose(4, 3, 1, (0.4, 0.2, 0.3), 0.9, 0.5))
    open_page(browser, server)
    assert browser.column("map", "heading") == [0.5]
    assert browser.column("map", "protection") == [0.9]
    assert {kind for _, kind in view.scene.tracks} == {TrackKind.CORRECTED, TrackKind.TRUE}
    svg = browser.export("Map as SVG")
    texts = (
        "corrected",
        "true",
        "OUT_OF_DISTRIBUTION",
        "protection level",
        "heading",
        "anchor",
        "selected anchor",
    )
    assert [text for text in texts if f">{text}<" not in svg] == []
    assert f">{TrackKind.SMOOTHED.value}<" not in svg, "the legend lists what the map contains"
    assert "PNG" in browser.export("Map as PNG")[:8]
    csv = browser.export("Map as CSV")
    assert "data,x,y,raw,corrected,x1,y1,status\nranges,0,0,5.2" in csv
    browser.click("checkbox", "correction heat map")
    browser.wait("cells", lambda: len(browser.column("map", "mean")) > 0)
    assert browser.export("Pairs as CSV").splitlines()[1].startswith("pairs,1,7,")


def test_map_is_moved_by_keys_and_follows_the_tag(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    open_page(browser, server)

    def x_range() -> tuple[float, float]:
        return tuple(
            browser.run(
                "const {start, end} = Bokeh.documents[0].get_model_by_name('map').x_range; return [start, end]"
            )
        )

    def press(key: str) -> None:
        browser.driver.execute_script("document.getElementById('map').focus()")
        browser.driver.switch_to.active_element.send_keys(key)

    start, end = x_range()
    press("\ue014")
    browser.wait("it to move to the right", lambda: x_range()[0] > start)
    press("+")
    browser.wait("it to zoom in", lambda: x_range()[1] - x_range()[0] < 0.9 * (end - start))
    browser.click("button", "Follow")
    with view.lock:
        view.scene.add_pose("tag", Pose(60, 3, 1))
    browser.wait("the tag in the centre", lambda: abs(sum(x_range()) / 2 - 60) < 1)
    browser.click("button", "Fit")
    browser.wait("the anchors", lambda: x_range()[0] < 0)
    assert browser.find("button", "Follow").get_attribute("aria-pressed") == "false"


def test_pointer_shows_values_and_a_click_selects_an_anchor(
    browser: Browser, view: View, server: ViewerServer
) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    fill_scene(view)
    open_page(browser, server)

    def move(name: str, x: float, y: float) -> ActionChains:
        """Move the pointer to coordinates of a figure."""
        browser.scroll_to(name)
        left, top = browser.run(
            "const view = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(arguments[0])), {x_scale, y_scale} = view.frame;"
            "const {left, top} = view.el.getBoundingClientRect();"
            "return [left + x_scale.compute(arguments[1]), top + y_scale.compute(arguments[2])]",
            name, x, y,
        )  # fmt: skip
        actions = ActionChains(browser.driver)
        actions.w3c_actions.pointer_action.move_to_location(round(left), round(top))
        actions.perform()
        return ActionChains(browser.driver)

    tips = (
        "const found = [], search = (root) => root.querySelectorAll('*').forEach((e) => { if (e.shadowRoot) {"
        " if (e.className.includes('bk-Tooltip')) found.push(e.shadowRoot.textContent); search(e.shadowRoot); }});"
        "search(document); return found.join()"
    )
    for name, x, y, texts in (
        ("strip", -3.0, 5.2, ("5.300", "5.100")),
        ("cir", 0.0, 500.0, ("1000.000",)),
        ("errors", 0.52, 10.0, ("0.500", "0.550", "50.000")),
    ):
        move(name, x, y)
        browser.wait(name, lambda texts=texts: all(text in browser.run(tips) for text in texts))
    move("map", 8.0, 0.0).click().perform()
    browser.wait("the other anchor", lambda: browser.find("heading", "Range, last 60 s: anchor 2, tag 7"))
    assert browser.console_messages() == []


def test_dark_page_and_labels_are_readable(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)

    def colours() -> list[str]:
        return browser.run(
            "const {renderers, right} = Bokeh.documents[0].get_model_by_name('map');"
            "const texts = renderers.filter((r) => r.glyph.type === 'Text');"
            "return [...texts.flatMap(({level, glyph: g}) => [level, g.text_color.value, g.background_fill_color.value]),"
            " right.find((part) => part.title).title_text_color]"
        )

    with browser.dark_mode():
        open_page(browser, server, 400)
        browser.wait("labels above the tracks", lambda: colours() == ["annotation", PAPER, NIGHT, PAPER])
        browser.wait("a hint", lambda: "scroll the table sideways" in browser.text())


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
    for stamp_s, *position, _ in scene.tracks["tag", TrackKind.RAW].points:
        assert position == pytest.approx(expected[stamp_s], abs=1e-6)
    assert position[:2] == pytest.approx((5.0, 2.0), abs=0.3)
    assert scene.pairs[2, 7].samples[-1].residual_m == pytest.approx(0.5)


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
            assert np.isfinite(track.columns()[:, 1:3]).all()


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
    for colour in {look.colour for look in looks} | set(TRACK_COLOURS.values()) - {None}:
        for paper in (PAPER, NIGHT) if colour else ():
            assert contrast(colour, paper) >= 3.0, (colour, paper)
    assert contrast(PAPER, NIGHT) >= 4.5


def test_page_is_small_and_compressed(view: View, server: ViewerServer) -> None:
    fill_scene(view)
    page = fetch(server, Host=f"localhost:{server.port}", **{"Accept-Encoding": "gzip"})
    names = re.findall(r'src="/([^"]+)"', gzip.decompress(page.body).decode())
    assert [name.split("?")[0] for name in names] == ["static/js/bokeh.min.js"]
    script = fetch(server, names[0], Host=f"localhost:{server.port}", **{"Accept-Encoding": "gzip"})
    assert len(page.body) + len(script.body) < 500_000


def test_floor_plan_is_read_as_map_server_does(tmp_path: Path) -> None:
    pixels = np.full((20, 40), 254, np.uint8)
    pixels[0] = 0
    Image.fromarray(pixels).save(tmp_path / "plan.pgm")
    path = tmp_path / "plan.yaml"
    path.write_text("{image: plan.pgm, resolution: 0.1, origin: [-1, -2, 0.5], negate: 0}")
    plan = load_floor_plan(path)
    assert (plan.x, plan.y, plan.yaw) == (-1.0, -2.0, 0.5)
    assert (plan.width, plan.height) == pytest.approx((4.0, 2.0))
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(plan.url.partition(",")[2]))))
    assert (shown[..., 3] > 0).sum() == 40, "only walls are opaque"


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("{", "not YAML"),
        ("", "empty"),
        ("[1]", "invalid fields"),
        ("{image: plan.pgm, resolution: 0.1, origin: [0, 0]}", "invalid fields"),
        ("{image: plan.pgm, resolution: .nan, origin: [0, 0, 0]}", "implausible resolution"),
        ("{image: plan.pgm, resolution: 0.1, origin: [1e9, 0, 0]}", "implausible resolution or origin"),
        ("{image: absent.pgm, resolution: 0.1, origin: [0, 0, 0]}", "absent.pgm"),
        ("{image: plan.yaml, resolution: 0.1, origin: [0, 0, 0]}", "not a readable image"),
    ],
)
def test_invalid_floor_plan_is_refused(tmp_path: Path, text: str, cause: str) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "plan.pgm")
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(ParameterError, match=cause):
        load_floor_plan(path)


def test_empty_page_has_axes_and_no_dark_blocks(browser: Browser, view: View, server: ViewerServer) -> None:
    open_page(browser, server)
    assert len(browser.column("waterfall", "image")) == 0
    ends = browser.run(
        "return ['cir', 'strip', 'errors'].flatMap((name) => ['x_range', 'y_range'].flatMap((range) => {"
        "  const {start, end} = Bokeh.documents[0].get_model_by_name(name)[range]; return [start, end]}))"
    )
    assert all(end is not None and math.isfinite(end) for end in ends)
    assert browser.cards() == {}
    none = "No CIRs: the source sends none, or no raw ranges are received."
    assert empty_figures(browser) == {
        "strip": "No range of this pair yet.", "cir": none, "waterfall": none, "errors": "No true ranges.",
        "history": "No residuals of this pair yet.", "positions": "No positions.",
    }  # fmt: skip
    assert browser.console_messages() == []
    browser.screenshot("viewer_empty")


def test_anchors_have_a_traffic_light_and_advice(
    browser: Browser, view: View, server: ViewerServer, clock: Clock
) -> None:
    with view.lock:
        view.scene.set_anchors([Anchor(1, (0, 0, 2)), Anchor(2, (8, 0, 2))])
        view.scene.add_pose("tag", Pose(4, 3, 2, stamp_s=1005.0))
        for step in range(20):
            for anchor, range_m in ((1, 5.0), (2, 5.42)):
                view.scene.add_sample(
                    (anchor, 7), Sample(1005.0 + step / 10, range_m, range_m, 0.1, Status.OK)
                )
    open_page(browser, server)
    browser.wait(
        "advice", lambda: "Anchor 2 reads 0.42 m long: calibrate, or check its position." in browser.text()
    )
    assert [row["state"] for row in browser.table("Anchors")] == [health.GOOD, health.BAD]
    assert [row["state"] for row in browser.table("Pairs")] == [health.GOOD, health.BAD]
    browser.click("checkbox", "predicted accuracy")
    browser.wait("the map", lambda: len(browser.column("map", "dw")) == 1)
    clock.now_s = 20.0
    browser.wait("advice for all", lambda: "No anchor answers: check the tag" in browser.text())


@pytest.mark.parametrize(
    ("residuals_m", "nlos", "expected"),
    [
        ([0.0, 0.8, 0.0], [0.0, 94.0, 0.0], "Anchor 2 reads 0.80 m long, with 94 % NLOS: its line of sight"),
        ([0.0, -0.4, 0.0], [0.0, 0.0, 0.0], "Anchor 2 reads 0.40 m short: calibrate"),
        (
            [0.2, 0.8, 0.3],
            [0.0, 94.0, 0.0],
            "All anchors read too long, 0.30 m in the median: a common cause",
        ),
        ([0.2, -0.8, 0.3], [0.0, 0.0, 0.0], "The ranges of all anchors contradict the position: check ids"),
        (
            [0.2, 0.8, 0.3],
            [90.0, 94.0, 60.0],
            "The ranges of all anchors contradict the position, and most are NLOS",
        ),
        ([math.nan] * 3, [math.nan] * 3, ""),
    ],
)
def test_advice_names_the_probable_cause(residuals_m: list[float], nlos: list[float], expected: str) -> None:
    others = dict.fromkeys(("rate", "lost", "not_ok", "stopped", "displaced"), 0.0)
    anchors = {
        number: others | {"nlos": share, "residual": residual_m}
        for number, (residual_m, share) in enumerate(zip(residuals_m, nlos, strict=True), 1)
    }
    common, advice = health.advice(anchors)
    texts = [text for text in (common, *advice.values()) if text]
    assert len(texts) == (expected != "")
    assert "".join(texts).startswith(expected)


def test_figures_are_those_of_the_selected_tag() -> None:
    scene = Scene(Clock())
    for tag, name, error_m in ((7, "tag", 0.1), (9, "tag_9", 0.5)):
        scene.add_sample((1, tag), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
        for step in range(20):
            time_s = 1000.0 + step / 10
            scene.add_position(f"tag_{tag}", TrackKind.TRUE, (time_s, step / 10, 0.0, 0.0, math.nan))
            scene.add_pose(name, Pose(step / 10, error_m, 0.0, stamp_s=time_s, sd_m=0.2))
    for tag, expected in ((7, "0.100 m"), (9, "0.500 m")):
        assert live_cards(scene, tag)[0] == ["Position error, now", expected, f"tag {tag}, horizontal"]
    scene.add_sample((1, 5), Sample(1000.0, 5.3, 5.1, 0.1, Status.OK))
    for tag in (5, 7):
        assert live_cards(scene, tag)[0] == ["Position", "-", f"no positions of tag {tag}"], (
            "the tag is ambiguous"
        )


def test_names_on_the_map_do_not_cover_each_other(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    with view.lock:
        view.scene.set_anchors([Anchor(n, (0.2 * n, 0.0, 2.0), name=f"column {n}") for n in range(30)])
    browser.open(server.url + "#anchor=17&tag=7")
    browser.wait("names", lambda: browser.column("map", "text")[:2] == ["tag 7", "column 17"])
    shown = browser.column("map", "text")
    assert 3 < len(shown) < 15
    for _ in range(8):
        browser.driver.find_element("id", "map").send_keys("+")
    browser.wait("others after zooming in", lambda: set(browser.column("map", "text")) - set(shown))


def test_predicted_accuracy_is_hdop_times_standard_deviation() -> None:
    anchors = np.array([[0.0, 0.0, 1.0], [8.0, 0.0, 1.0], [8.0, 8.0, 1.0], [0.0, 8.0, 1.0]])
    image, low, size = health.predicted_accuracy(anchors, 1.0, 0.1)
    centre = np.array([*(low + size * (20 + 0.5) / 40), 1.0])
    assert image[20, 20] == pytest.approx(0.1 * dop(anchors, centre, level=True).hdop, rel=1e-5)
    assert np.isinf(health.predicted_accuracy(anchors[:1], 1.0, 0.1)[0]).all()


def test_many_diagnostics_scroll_and_a_printed_page_is_complete(
    browser: Browser, view: View, server: ViewerServer
) -> None:
    fill_scene(view)
    with view.lock:
        for number in range(64):
            view.scene.set_node_status(f"node_{number}", NodeStatus(0, "text " * 60))
    open_page(browser, server)
    assert browser.run("return document.documentElement.scrollHeight") < 3500
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        clipped = "return [...document.querySelectorAll('.scroll')].filter((e) => e.scrollHeight > e.clientHeight + 1).length"
        browser.wait("complete tables", lambda: browser.run(clipped) == 0)
        overlaps = (
            "const boxes = ['map', 'strip', 'cir', 'waterfall', 'errors'].map((id) => document.getElementById(id).getBoundingClientRect());"
            "return boxes.some((a, i) => boxes.some((b, j) => i < j && a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1))"
        )
        assert not browser.run(overlaps)
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_selected_pair_survives_a_restart(browser: Browser, view: View) -> None:
    fill_scene(view)
    with ViewerServer(view, port=0) as server:
        browser.open(server.url + "#anchor=3&tag=7")
        browser.wait(
            "the requested pair", lambda: browser.find("heading", "Range, last 60 s: anchor 3, tag 7")
        )
        assert empty_figures(browser)["strip"] == "No range of this pair yet."
        browser.run("window.before = true")
    browser.wait("the loss of the viewer", lambda: "Connection lost" in browser.text())
    with view.lock:
        view.scene.add_sample((3, 7), Sample(1005.0, 5.3, 5.2, 0.1, Status.OK))
    with ViewerServer(view, port=server.port):
        browser.wait(
            "the page to come back by itself", lambda: not browser.run("return window.before ?? false")
        )
        browser.wait("its range", lambda: len(browser.column("strip", "raw")) == 1)
        assert "anchor=3" in browser.driver.current_url


def test_token_protects_page_script_and_websocket(browser: Browser, view: View) -> None:
    with ViewerServer(view, "0.0.0.0", 0, token="s3cret/+") as server:
        assert server.warning == ""
        for path in ("", "ws", "static/js/bokeh.min.js", "?token=wrong", "?token="):
            assert fetch(server, path, Host=f"localhost:{server.port}").status == 403
        fill_scene(view)
        browser.open(server.url)
        browser.wait("the page", browser.ready)
        browser.wait("the pairs", lambda: len(browser.column("pairs", "anchor")) == 2)
        with view.lock:
            view.scene.add_sample((3, 7), Sample(1005.0, 5.3, 5.2, 0.1, Status.OK))
        browser.wait("updates", lambda: len(browser.column("pairs", "anchor")) == 3)
    with ViewerServer(view, "0.0.0.0", 0) as server:
        assert "everyone in the network" in server.warning


def test_ipv6_address_is_served(browser: Browser, view: View) -> None:
    with ViewerServer(view, "::1", 0) as server:
        assert server.url == f"http://[::1]:{server.port}/"
        fill_scene(view)
        open_page(browser, server)
        assert browser.column("pairs", "anchor") == ["1", "2"]


def test_long_names_do_not_widen_the_page(browser: Browser, view: View, server: ViewerServer) -> None:
    fill_scene(view)
    name = "warehouse_door_north_" * 20
    with view.lock:
        view.scene.set_anchors([Anchor(n, (4.0 * n, 0, 2), name=name) for n in (1, 2)])
        view.scene.set_node_status(name, NodeStatus(1, name, determinations=(f"{name}: {name}",)))
        view.scene.add_pose(name, Pose(4.0, 3.0, 1.0, stamp_s=1000.0))
        view.scene.incidents.found.append((0.0, name))
    view.title = name
    open_page(browser, server)
    browser.wait("the names", lambda: name in browser.text())
    browser.wait("everything within 1280 pixels", lambda: not browser.cut_off(1280))
