"""The viewer's page in a real browser and its server, on a scene that the test fills."""

import gzip
import math
import re
import socket
import time
from collections.abc import Iterator
from functools import partial
from http.client import HTTPConnection, HTTPResponse

import numpy as np
import pytest
from browser import Browser
from drawn import Clock

from benchmarks.equipment.page_clients import PageClients
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.anchors import Anchor
from uwb_mitigation.types.measurement import Cir, Encoding, Status
from uwb_mitigation.viewer.histories import Pose, Sample
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import NodeStatus, Scene
from uwb_mitigation.viewer.server import ViewerServer
from uwb_mitigation.viewer.state import View

HOSTILE = "<img src=x onerror=window.pwned=1><script>window.pwned=1</script>$$x$$"
RANGES_OF_MAP = (
    "const {x_range: x, y_range: y} = Bokeh.documents[0].get_model_by_name('map');"
    "return [x.start, x.end, y.start, y.end]"
)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def view(clock: Clock) -> View:
    """Two pairs of tag 7 at 10 Hz each; the ranges of anchor 2 are out of distribution and 0.5 m too long."""
    view = View(scene := Scene(clock), "UWB ranges")
    scene.set_anchors([Anchor(1, (0, 0, 2), name=HOSTILE), Anchor(2, (8, 0, 2))])
    scene.set_node_status(HOSTILE, NodeStatus(1, HOSTILE))
    for step in range(50):
        time_s = 1000.0 + step / 10
        for anchor in (1, 2):
            magnitude = np.full(200, 10, np.int16)
            magnitude[20:40] = 1000 * anchor
            scene.set_cir((anchor, 7), Cir(magnitude, Encoding.MAGNITUDE, 730, 750.4, noise_threshold=120))
            status = Status.OK if anchor == 1 else Status.OUT_OF_DISTRIBUTION
            true_m, range_m = (5.1, 5.1) if anchor == 1 else (4.8, 5.3)
            scene.add_sample((anchor, 7), Sample(time_s, 5.3, range_m, 0.1, status, true_m))
        scene.add_pose(HOSTILE, Pose(4.0, 3.0, 1.0, stamp_s=time_s), TrackKind.TRUE)
        scene.add_pose("tag", Pose(4 + math.sin(step / 20), 3, 1, 0.4, 0.2, 0.3, stamp_s=time_s))
    return view


@pytest.fixture
def server(view: View) -> Iterator[ViewerServer]:
    with ViewerServer(view, port=0) as server:
        yield server


def open_page(browser: Browser, server: ViewerServer, width: int = 1280, height: int = 1150) -> None:
    browser.open(server.url, width, height)
    browser.wait("the page", browser.ready)


def add_range(view: View, range_m: float, anchor: int = 1, status: Status = Status.OK) -> None:
    with view.scene.lock:
        view.scene.add_sample((anchor, 7), Sample(1005.0, 9.9, range_m, 0.1, status))


def test_hostile_names_are_text_and_scripts_do_not_run(browser: Browser, server: ViewerServer) -> None:
    open_page(browser, server)
    assert browser.column("pairs", "corrected") == pytest.approx([5.1, 5.3])
    assert max(browser.column("cir", "magnitude")) == 1000.0
    assert sum(browser.column("errors", "raw")) == 100
    assert len(browser.column("strip", "raw")) == 50
    first = browser.table("Pairs")[0]
    names = ("anchor, tag", "corrected, m", "raw, m", "correction, m", "not OK, %", "rate, Hz", "lost, %")
    assert [first[name] for name in names] == ["1, 7", "5.100", "5.300", "0.200", "0", "10.0", "-"]
    assert browser.cards()["Mean absolute range error, since the start"] == ("0.250 m", "raw: 0.350 m")
    browser.wait("the hostile name as text", lambda: HOSTILE in browser.text())
    assert browser.console_messages() == []
    browser.run(
        "const script = document.createElement('script');"
        "script.textContent = 'window.pwned = 1'; document.body.append(script);"
        "const image = document.createElement('div'); document.body.append(image);"
        "image.innerHTML = '<img src=x: onerror=\"window.pwned = 2\">'"
    )
    browser.wait("the refusal", lambda: "Content Security Policy" in "".join(browser.console_messages()))
    assert browser.run("return window.pwned ?? null") is None


def test_map_view_is_fixed_until_changed(browser: Browser, view: View, server: ViewerServer) -> None:
    open_page(browser, server)

    def view_of_map() -> list[float]:
        return browser.run(RANGES_OF_MAP)

    def settled() -> list[float] | None:
        """Return the view after the final layout of the page."""
        seen = view_of_map()
        for _ in range(4):
            time.sleep(0.5)
            if view_of_map() != seen:
                return None
        return seen

    def moved(x: float) -> None:
        with view.scene.lock:
            view.scene.add_pose("tag", Pose(x, 3, 0))
        browser.wait("the tag", lambda: x in browser.column("map", "x1"))

    def press(key: str) -> None:
        browser.driver.execute_script("document.getElementById('map').focus()")
        browser.driver.switch_to.active_element.send_keys(key)

    first = browser.wait("a view", settled)
    assert first[0] < 0 < 8 < first[1], "both anchors"
    moved(50.0)
    assert view_of_map() == first
    browser.click("button", "Fit")
    browser.wait("everything", lambda: view_of_map()[1] > 50)
    fitted = view_of_map()
    press("\ue014")
    browser.wait("it to move to the right", lambda: view_of_map()[0] > fitted[0])
    press("+")
    zoomed = browser.wait("it to zoom in", settled)
    assert zoomed[1] - zoomed[0] < 0.9 * (fitted[1] - fitted[0])
    moved(90.0)
    with view.scene.lock:
        view.scene.set_anchors([Anchor(5, (-70, 0, 2))])
    browser.wait("the new anchor", lambda: "5" in browser.column("map", "id"))
    assert view_of_map() == zoomed


def test_page_shows_how_old_it_is_and_can_be_paused_and_resumed(
    browser: Browser, view: View, server: ViewerServer, clock: Clock
) -> None:
    open_page(browser, server)
    with view.scene.lock:
        browser.wait("its age without updates", lambda: "s behind" in browser.text())
    browser.wait("the state", lambda: "LIVE 0.0 s" in browser.text())
    browser.click("button", "Pause")
    # Wait for the server.
    browser.wait("the button", lambda: browser.find("button", "Resume"))
    with PageClients(server.url, 1) as other:
        add_range(view, 9.5)
        before = other.received[0]
        browser.wait("updates of the other page", lambda: other.received[0] > before + 1)
    assert browser.column("pairs", "corrected")[0] == pytest.approx(5.1)
    assert "PAUSED" in browser.text()
    browser.driver.find_element("css selector", "body").send_keys(" ")
    browser.wait("the new range", lambda: browser.column("pairs", "corrected")[0] == pytest.approx(9.5))
    clock.now_s = 12.0
    browser.wait("the age", lambda: "NO RANGES" in browser.text() and "LIVE" not in browser.text())


def test_pair_is_selected_by_click_and_key_during_updates(browser: Browser, view: View, server: ViewerServer):
    from selenium.webdriver.common.action_chains import ActionChains

    open_page(browser, server)
    title = "Last CIR: anchor {}, tag 7"
    rows = browser.wait("rows", lambda: browser.driver.find_elements("css selector", "#pairs tbody tr"))
    ActionChains(browser.driver).click_and_hold(rows[1]).perform()
    add_range(view, 9.5, 2, Status.OUT_OF_DISTRIBUTION)
    browser.wait("it in the table", lambda: browser.table("Pairs")[1]["corrected, m"] == "9.500")
    ActionChains(browser.driver).release().perform()
    browser.wait("the other CIR", lambda: max(browser.column("cir", "magnitude")) == 2000.0)
    browser.wait("it in the URL", lambda: "#anchor=2&tag=7" in browser.driver.current_url)
    assert rows[1].get_attribute("aria-current") == "true"
    add_range(view, 5.3, 3, Status.NO_CIR)
    browser.wait("the new pair", lambda: len(browser.table("Pairs")) == 3)
    browser.run("document.querySelector('#pairs tbody tr:last-child').focus()")
    browser.driver.switch_to.active_element.send_keys("\ue007")
    browser.wait("its title", lambda: browser.find("heading", title.format(3)))
    browser.wait("why it has no CIR", lambda: empty_figures(browser)["cir"] == "No CIR of this pair yet.")


def test_implausible_values_do_not_break_the_page(browser: Browser, view: View, server: ViewerServer) -> None:
    nan, inf = math.nan, math.inf
    with view.scene.lock:
        view.scene.set_anchors([Anchor(1, (0, 0, 2)), Anchor(2, (8, 0, nan)), Anchor(3, (0, 1e300, nan))])
        for anchor, values in ((1, (3e38, -3e38, inf)), (2, (nan, nan, nan)), (3, (inf, -inf, 0.1))):
            view.scene.add_sample((anchor, 7), Sample(1005.0, *values, Status.BAD_CIR, 3e38))
            view.scene.add_sample((anchor, 7), Sample(1005.0, *values, Status.BAD_CIR, 5.0))
        view.scene.add_pose("tag", Pose(4, 3, nan, 1e300))
        view.scene.add_pose("tag", Pose(1e300, 3, 0))
        view.scene.add_pose("tag", Pose(4.0, -1e300, 0.0, stamp_s=1005.0), TrackKind.TRUE)
    open_page(browser, server)
    assert browser.console_messages() == []
    shown = [cell for row in browser.table("Pairs") for cell in row.values() if "e+" in cell]
    assert shown == ["3.0e+38", "-3.0e+38"]
    assert max(map(abs, axis_ends(browser, "strip", "map"))) < 100
    assert browser.cards()["Mean absolute range error, since the start"][0] == "0.250 m"


def axis_ends(browser: Browser, *figures: str) -> list[float]:
    return browser.run(
        "return arguments[0].flatMap((name) => ['x_range', 'y_range'].flatMap((range) => {"
        "  const {start, end} = Bokeh.documents[0].get_model_by_name(name)[range]; return [start, end]}))",
        figures,
    )


def empty_figures(browser: Browser) -> dict[str, str]:
    """Return the messages in figures without data, {figure: message}."""
    return browser.run(
        "return Object.fromEntries([...document.querySelectorAll('[data-empty]')].map((e) => [e.id, e.dataset.empty]))"
    )


def test_empty_page_has_axes_and_messages(browser: Browser) -> None:
    with ViewerServer(View(Scene(Clock())), port=0) as server:
        open_page(browser, server)
        ends = axis_ends(browser, "cir", "strip", "errors")
        assert all(end is not None and math.isfinite(end) for end in ends)
        assert browser.cards() == {}
        assert empty_figures(browser) == {
            "strip": "No range of this pair yet.", "errors": "No true ranges.", "positions": "No positions.",
            "cir": "No CIRs: the source sends none, or no raw ranges are received.",
            "history": "No residuals of this pair yet.",
        }  # fmt: skip
        assert browser.console_messages() == []


def fetch(server: ViewerServer, path: str = "", **headers: str) -> HTTPResponse:
    client = HTTPConnection("127.0.0.1", server.port, timeout=60)
    client.request("GET", f"/{path}", headers=headers)
    response = client.getresponse()
    response.body = response.read()
    client.close()
    return response


SCRIPT = "static/js/bokeh.min.js"


def test_unknown_host_is_refused(view: View, server: ViewerServer) -> None:
    for own in ("localhost", "LocalHost", "127.0.0.1"):
        assert fetch(server, SCRIPT, Host=f"{own}:{server.port}").status == 200
    names = "evil.example", f"evil.example:{server.port}", "localhost", f"localhost:{server.port + 1}"
    for path in ("", "ws", SCRIPT):
        assert [fetch(server, path, Host=name).status for name in names] == [403] * 4
    assert view.pages == 0
    with ViewerServer(view, port=0, origins=("robot.local:5006",)) as other:
        assert fetch(other, SCRIPT, Host="robot.local:5006").status == 200


def test_content_security_policy_has_a_nonce_for_each_response(server: ViewerServer) -> None:
    headers = {"Host": f"localhost:{server.port}", "X-Nonce": "mine"}
    paths = (SCRIPT, SCRIPT, "absent")
    policies = [fetch(server, path, **headers).headers["Content-Security-Policy"] for path in paths]
    assert len(set(policies)) == 3
    for policy in policies:
        (scripts,) = [part for part in policy.split("; ") if part.startswith("script-src")]
        assert "unsafe" not in scripts
        assert "mine" not in scripts
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy


def test_swipe_over_a_figure_scrolls_a_phone(browser: Browser, server: ViewerServer) -> None:
    with browser.touch_screen():
        open_page(browser, server, 400, 800)
        for name in ("map", "cir", "errors"):
            before = browser.scroll_to(name)
            browser.swipe(200, 400, 250 if before < 500 else -250)
            scrolled = partial(lambda before: abs(browser.run("return scrollY") - before) > 100, before)
            browser.wait(f"the page to scroll by {name}", scrolled)
        assert browser.console_messages() == []


def test_long_names_and_ids_fit_the_screen(browser: Browser, view: View, server: ViewerServer) -> None:
    view.title = name = "warehouse_door_north_" * 20
    with view.scene.lock:
        pair = 0xDECA010203040506, 0xDECA0102030407F8
        view.scene.add_sample(pair, Sample(1005.0, -9.9, 123.456, 12.345, Status.OK))
        view.scene.set_anchors([Anchor(n, (4.0 * n, 0, 2), name=name) for n in (1, 2)])
        view.scene.set_node_status(name, NodeStatus(1, name, determinations=(f"{name}: {name}",)))
        view.scene.add_pose(name, Pose(4.0, 3.0, 1.0, stamp_s=1000.0))
        view.scene.incidents.add(0.0, name)
    open_page(browser, server, 1280, 2000)
    browser.wait("the names", lambda: name in browser.text())
    for width in (1280, 1024, 400):
        # Figures change their width asynchronously.
        browser.wait(f"everything within {width} pixels", partial(lambda w: not browser.cut_off(w), width))
        assert browser.run("return document.querySelector('header').clientHeight") <= 60


def test_session_of_a_left_page_is_discarded(browser: Browser, view: View, server: ViewerServer) -> None:
    open_page(browser, server)
    assert view.pages == 1
    browser.open("about:blank")
    browser.wait("it to be forgotten", lambda: view.pages == 0)
    browser.driver.back()
    browser.wait("it to be there again", lambda: view.pages == 1 and browser.ready())


def test_wildcard_and_ipv6_addresses_are_served(view: View) -> None:
    with ViewerServer(view, "0.0.0.0", 0) as server, PageClients(server.url, 1):
        assert server.url == f"http://localhost:{server.port}/"
        assert "everyone in the network" in server.warning
        assert view.pages == 1
        for name in (socket.gethostname(), "127.0.0.1"):
            assert fetch(server, SCRIPT, Host=f"{name}:{server.port}").status == 200
        for name in ("203.0.113.7", "evil.example"):
            assert fetch(server, SCRIPT, Host=f"{name}:{server.port}").status == 403
    with ViewerServer(view, "::1", 0) as server, PageClients(server.url, 1):
        assert server.url == f"http://[::1]:{server.port}/"


def test_unusable_address_is_refused(server: ViewerServer, view: View) -> None:
    with pytest.raises(ParameterError, match="an address of this machine"):
        ViewerServer(view, "203.0.113.7", 0)
    with pytest.raises(ParameterError, match=str(server.port)):
        ViewerServer(view, port=server.port)


def test_token_protects_page_script_and_websocket(browser: Browser, view: View) -> None:
    with ViewerServer(view, "0.0.0.0", 0, token="s3cret/+") as server:
        assert server.warning == ""
        for path in ("", "ws", SCRIPT, "?token=wrong", "?token="):
            assert fetch(server, path, Host=f"localhost:{server.port}").status == 403
        open_page(browser, server)
        add_range(view, 5.2, 3)
        browser.wait("updates", lambda: len(browser.column("pairs", "anchor")) == 3)
    with ViewerServer(view, "localhost", 0, token="generate") as server:
        assert len(server.url.partition("?token=")[2]) > 20
        assert fetch(server, "?token=generate", Host=f"localhost:{server.port}").status == 403


def test_page_is_small_and_compressed(server: ViewerServer) -> None:
    headers = {"Host": f"localhost:{server.port}", "Accept-Encoding": "gzip"}
    page = fetch(server, **headers)
    names = re.findall(r'src="/([^"]+)"', gzip.decompress(page.body).decode())
    assert [name.split("?")[0] for name in names] == [SCRIPT]
    assert len(page.body) + len(fetch(server, names[0], **headers).body) < 500_000


def test_pointer_shows_values_and_a_click_selects_an_anchor(browser: Browser, server: ViewerServer) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

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


def test_names_on_the_map_do_not_cover_each_other(browser: Browser, view: View, server: ViewerServer) -> None:
    with view.scene.lock:
        view.scene.set_anchors([Anchor(n, (0.2 * n, 0.0, 2.0), name=f"column {n}") for n in range(30)])
    browser.open(server.url + "#anchor=17&tag=7")

    def shown() -> list[str]:
        """Return the visible names."""
        return browser.run(
            "const map = window.Bokeh?.documents[0]?.get_model_by_name('map');"
            "return (map?.renderers ?? []).filter((r) => r.glyph.text).flatMap((r) =>"
            "  r.data_source.data[r.glyph.text.field].filter((_, i) => r.view.filter.booleans?.[i]))"
        )

    browser.wait("names", lambda: {"tag 7", "column 17 selected"} <= set(shown()))
    first = shown()
    assert 3 < len(first) < 15
    for _ in range(8):
        browser.driver.find_element("id", "map").send_keys("+")
    browser.wait("others after zooming in", lambda: set(shown()) - set(first))


def test_selected_pair_survives_a_restart(browser: Browser, view: View) -> None:
    with ViewerServer(view, port=0, token="s3cret/+") as server:
        browser.open(server.url + "#anchor=3&tag=7")
        title = "Range, last 60 s: anchor 3, tag 7"
        browser.wait("the requested pair", lambda: browser.find("heading", title))
        assert empty_figures(browser)["strip"] == "No range of this pair yet."
        browser.run("window.before = true")
    browser.wait("the loss of the viewer", lambda: "Connection lost" in browser.text())
    assert "Position " not in browser.text().partition("Anchors")[0], "no old verdict"
    add_range(view, 5.2, 3)
    # Without the cookie, the request of the waiting page has the token. A viewer that hangs does not answer it.
    browser.driver.delete_all_cookies()
    with socket.create_server(("127.0.0.1", server.port)) as hanging:
        request, _ = hanging.accept()
        assert request.recv(4) == b"HEAD"
    with request, ViewerServer(again := View(view.scene), port=server.port, token="s3cret/+"):
        browser.wait("the page to come back", lambda: not browser.run("return window.before ?? false"))
        assert again.pages == 1, "waiting makes no session"
        browser.wait("its range", lambda: len(browser.column("strip", "raw")) == 1)
        assert "anchor=3" in browser.driver.current_url
