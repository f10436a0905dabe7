"""A page of the viewer without a browser, and what it shows."""

import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from bag_material import corrected, record, write_corrected
from bokeh.document import Document

from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.viewer.page import Page
from uwb_mitigation.viewer.state import View


class Clock:
    """A clock that changes only when a test sets it."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def corrected_bag(path: Path, numbers: Iterable[int], **changes: Any) -> Path:
    """Write a bag with corrected ranges of `bag_material`, with changes of each; return its path."""
    with BagWriter(path, {}) as out:
        for number in numbers:
            write_corrected(out, record(number).measurement, replace(corrected(number), **changes))
    return path


class Drawn:
    """A page without a browser.

    Attributes:
        controls: its texts and states.
    """

    def __init__(self, view: View) -> None:
        self.document, self._player = Document(), view.player
        self.page = Page(self.document, view)
        self.controls = self.document.get_model_by_name("controls")

    def send(self, name: str, *arguments: object) -> None:
        """Send a command of the page, and draw its result."""
        self.controls.command = [name, list(arguments), time.monotonic()]
        while self._player is not None and self._player.is_behind:
            self._player.advance()
        self.controls.acknowledged = self.controls.timing[0]

    def column(self, model: str, name: str) -> Any:
        """Return a column of the source of a named table, or of the first one of a figure."""
        found = self.document.get_model_by_name(model)
        sources = [r.data_source for r in found.renderers] if hasattr(found, "renderers") else [found]
        return next(source.data[name] for source in sources if name in source.data)

    def columns(self, figure: str, name: str) -> list[Any]:
        """Return the values in all columns with a name of a figure."""
        sources = [r.data_source for r in self.document.get_model_by_name(figure).renderers]
        return [value for source in sources for value in source.data.get(name, ())]

    def cards(self) -> dict[str, tuple[str, str]]:
        """Return the large figures, {title: (value, explanation)}."""
        return {title: (value, explanation) for title, value, explanation in self.controls.cards}
