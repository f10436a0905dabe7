"""What a report holds, and the page it becomes: HTML from a template, or JSON. What is in it is made elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.evaluation.tables import Provenance, Table

_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report.

    Attributes:
        id, title: which of the paper's it stands beside.
        alt: for who does not see it.
        note: how to read it; `paper_note`: what the paper's own shows.
        uri: the image, `data:`.
        numbers: what is drawn, for a program.
        provenance, missing: as of a table.
    """

    id: str
    title: str
    alt: str
    note: str
    paper_note: str
    uri: str
    numbers: Mapping[str, object]
    provenance: Provenance
    missing: str = ""

    def as_json(self) -> dict[str, object]:
        """All but the image."""
        return {key: value for key, value in asdict(self).items() if key != "uri"}


@dataclass(frozen=True, slots=True)
class Report:
    """A page: what it says above, its tables and its figures.

    Attributes:
        lacking: what is left out for want of results, and `to_fill`, the command that makes them; empty where all is
            there.
    """

    title: str
    data: str
    simulated: bool
    command: str
    lacking: str
    to_fill: str
    notices: tuple[str, ...]
    tables: tuple[Table, ...]
    pictures: tuple[Picture, ...]

    def as_json(self) -> dict[str, object]:
        """The same content for a program, without the images."""
        return {
            "title": self.title,
            "data": self.data,
            "simulated": self.simulated,
            "command": self.command,
            "lacking": self.lacking,
            "to_fill": self.to_fill,
            "notices": list(self.notices),
            "tables": [table.as_json() for table in self.tables],
            "figures": [picture.as_json() for picture in self.pictures],
        }

    def html(self) -> str:
        """One page that needs nothing else.

        Raises:
            MissingDependencyError: jinja2 is not installed.
        """
        return rendered("report.html.j2", report=self)


def rendered(template: str, **values: object) -> str:
    """A page of `templates/`.

    Raises:
        MissingDependencyError: jinja2 is not installed.
    """
    try:
        import jinja2
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "a report's page needs jinja2", valid="run `make setup-training`"
        ) from error
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values) + "\n"
