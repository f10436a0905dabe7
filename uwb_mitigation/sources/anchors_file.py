"""The file with the anchors of a site or recording."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.files import read_bounded, write_atomically
from uwb_mitigation.positioning.anchors import MAX_TEXT, AnchorMap, dump_anchors, parse_anchors


@runtime_checkable
class HasAnchors(Protocol):
    """A source with known anchor positions.

    Attributes:
        anchors: all anchors.
    """

    anchors: AnchorMap


def anchors_path(bag: Path) -> Path:
    """Return the path of a bag's anchors file: `X.anchors.yaml` in the folder of `X.mcap`."""
    return bag.with_name(bag.name.removesuffix(".mcap") + ".anchors.yaml")


def load_anchors(path: Path) -> AnchorMap:
    """Read an anchors file.

    Raises:
        ParameterError: it cannot be read, or does not have the format of `positioning.anchors`.
    """
    data = read_bounded(
        path, MAX_TEXT, ParameterError, "an anchors file (format: docs/background/positioning.md)"
    )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ParameterError("not a text file", where=str(path), valid="YAML in UTF-8") from error
    return parse_anchors(text, str(path))


def save_anchors(path: Path, anchors: AnchorMap, comment: str = "", *, force: bool = False) -> None:
    """Write an anchors file atomically.

    Raises:
        ParameterError: it exists and `force` is not given, or it cannot be written.
    """
    if path.exists() and not force:
        raise ParameterError("exists already", where=str(path), valid="--force replaces it")
    write_atomically(path, dump_anchors(anchors, comment), ParameterError)
