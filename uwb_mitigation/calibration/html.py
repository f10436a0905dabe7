"""Render HTML pages from templates."""

from __future__ import annotations

from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError


def render_page(template: str, folder: Path = Path(__file__).parent / "templates", **values: object) -> str:
    """Render a template in `folder` with the values.

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
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values) + "\n"
