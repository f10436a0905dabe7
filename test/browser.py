"""Chromium of the system, controlled by Selenium, for tests of pages."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

TIMEOUT_S = 120.0
CALL_S = 10.0
"""Timeout of one call; a call that a reload of the page interrupts is repeated."""

_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
)  # fmt: skip


INTERRUPTED = "aborted by navigation", "execution context", "stale element", "not found in the current frame"
"""Errors of calls whose page was replaced meanwhile."""

ROLES = {
    "button": "button", "checkbox": "input", "combobox": "select", "slider": "input",
    "table": "table", "heading": "h1, h2",
}  # fmt: skip
"""CSS selectors of the elements that can have a role."""


class Browser:
    """A browser window."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, url: str, width: int = 1280, height: int = 1000) -> None:
        self.resize(width, height)
        # An earlier page that reloads itself would cancel the navigation: leave it first.
        self._navigate("about:blank")
        self.wait("an empty page", lambda: self._shows("about:blank") or self._navigate("about:blank"))
        # Discard errors of the earlier page.
        self.driver.get_log("browser")
        # Once: a second call cancels a load that is slow on a busy machine.
        self._navigate(url)
        self.wait(url, lambda: self._shows(url.partition("#")[0]))

    def _navigate(self, url: str) -> None:
        """Start to load a page; the browser continues if it does not answer in time."""
        from selenium.common.exceptions import TimeoutException
        from urllib3.exceptions import ReadTimeoutError

        with suppress(TimeoutException, ReadTimeoutError):
            self.driver.get(url)

    def _shows(self, url: str) -> bool:
        """Return whether a page with this begin of its URL is loaded."""
        return self.run(
            "return document.readyState === 'complete' && location.href.startsWith(arguments[0])", url
        )

    def resize(self, width: int, height: int) -> None:
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )

    @contextmanager
    def touch_screen(self) -> Iterator[None]:
        """Emulate a phone for the pages that are opened."""
        emulate = "Emulation.setTouchEmulationEnabled"
        self.driver.execute_cdp_cmd(emulate, {"enabled": True, "maxTouchPoints": 1})
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd(emulate, {"enabled": False})

    def scroll_to(self, name: str) -> float:
        """Scroll a named Bokeh figure into the middle; return the scroll position of the page."""
        return self.run(
            "const view = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(arguments[0]));"
            "view.el.scrollIntoView({block: 'center'}); return scrollY",
            name,
        )

    def swipe(self, x: int, y: int, distance: int) -> None:
        """Swipe upwards by a number of pixels."""
        steps = [("touchStart", y), *(("touchMove", y - distance * step // 10) for step in range(1, 11))]
        for kind, at in steps:
            touch = {"type": kind, "touchPoints": [{"x": x, "y": at}]}
            self.driver.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
            time.sleep(0.02)
        self.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    def run(self, script: str, *arguments: object) -> Any:
        return self._repeat(lambda: self.driver.execute_script(script, *arguments))

    def _repeat(self, call: Callable[[], Any]) -> Any:
        """Return the result of a call; it is repeated if the page does not answer or is reloaded meanwhile."""
        from selenium.common.exceptions import TimeoutException, WebDriverException
        from urllib3.exceptions import ReadTimeoutError

        end_s = time.monotonic() + TIMEOUT_S
        while True:
            try:
                return call()
            except (TimeoutException, ReadTimeoutError) as error:
                problem: Exception = error
            except WebDriverException as error:
                if not any(text in str(error) for text in INTERRUPTED):
                    raise
                problem = error
            if time.monotonic() > end_s:
                raise problem
            time.sleep(0.1)

    def wait(self, what: str, condition: Callable[[], Any]) -> Any:
        """Wait until `condition` is true, and return its result."""
        end_s = time.monotonic() + TIMEOUT_S
        while not (result := condition()):
            assert time.monotonic() < end_s, f"not within {TIMEOUT_S} s: {what}"
            time.sleep(0.05)
        return result

    def ready(self) -> bool:
        """Return whether a Bokeh page is loaded and drawn."""
        return bool(self.run("return !!(window.Bokeh && Bokeh.documents[0]?.is_idle)"))

    def find(self, role: str, name: str) -> Any:
        """Return the element with an ARIA role and an accessible name; None if it does not exist."""

        def search() -> Any:
            elements = self.driver.find_elements("css selector", ROLES[role])
            return next((e for e in elements if e.accessible_name == name and e.aria_role == role), None)

        return self._repeat(search)

    def click(self, role: str, name: str) -> None:
        """Click an element as soon as it exists."""
        self.wait(f"{role} {name}", lambda: self.find(role, name)).click()

    def table(self, name: str) -> list[dict[str, str]]:
        """Return the rows of a table, {title of the column: text}; the titles are the last row of its head."""
        table = self.find("table", name)
        if table is None:
            return []
        rows = self.run(
            "return [...arguments[0].rows].slice(arguments[0].tHead.rows.length - 1).map((row) => [...row.cells].map((cell) => cell.innerText.trim()))",
            table,
        )
        return [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]

    def cards(self) -> dict[str, tuple[str, str]]:
        """Return the large figures of the viewer, {title: (value, explanation)}."""
        texts = self.run(
            "return [...document.querySelectorAll('#cards div')].map((c) => [...c.children].map((e) => e.textContent))"
        )
        return {title: (value, explanation) for title, value, explanation in texts}

    def text(self) -> str:
        return self.run("return document.body.innerText")

    def column(self, model: str, name: str) -> list[Any]:
        """Return a column of the source of a named table or figure; empty before the page is loaded."""
        return self.run(
            "const m = window.Bokeh?.documents[0]?.get_model_by_name(arguments[0]);"
            "const sources = !m ? [] : m.renderers ? m.renderers.map((r) => r.data_source) : [m];"
            "return Array.from(sources.find((s) => arguments[1] in s.data)?.data[arguments[1]] ?? [])",
            model,
            name,
        )

    def console_messages(self) -> list[str]:
        return [line["message"] for line in self.driver.get_log("browser") if line["level"] != "INFO"]

    def cut_off(self, width: int) -> list[str]:
        """Return the elements that exceed the right edge of a page of this width without a scroll bar."""
        self.resize(width, 1100)
        if self.run("return document.documentElement.scrollWidth") <= width:
            return []
        return self.run(
            "return [...document.querySelectorAll('body *')].filter((e) => e.getBoundingClientRect().right > arguments[0])"
            ".map((e) => e.outerHTML.slice(0, 100)).slice(0, 5).concat(['the page'])",
            width,
        )


@contextmanager
def chromium() -> Iterator[Browser]:
    """Return a new browser; skip the test if the system has none."""
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no Chromium: sudo apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    # Otherwise a call waits for the end of any navigation, also of one that the page starts by itself.
    options.page_load_strategy = "none"
    for option in _OPTIONS:
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    window = webdriver.Chrome(options=options, service=Service(driver))
    window.command_executor.client_config.timeout = 3 * CALL_S
    window.set_script_timeout(CALL_S)
    try:
        yield Browser(window)
    finally:
        window.quit()
