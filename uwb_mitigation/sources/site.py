"""Files of a site: the anchors that belong to a recording, and the offsets that were learnt there."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol, runtime_checkable

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.files import read_bounded, write_whole
from uwb_mitigation.offsets import NO_OFFSETS, Offsets, dump_offsets, read_offsets
from uwb_mitigation.positioning.anchors import MAX_TEXT, AnchorMap, dump_anchors, parse_anchors
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.offset_learning import faded_sd


@runtime_checkable
class KnowsAnchors(Protocol):
    """A source that knows where its anchors stood.

    Attributes:
        anchors: all of them.
    """

    anchors: AnchorMap


def anchors_file(bag: Path) -> Path:
    """Where the anchors of a bag lie: beside it, `X.anchors.yaml` of `X.mcap`."""
    return bag.with_name(bag.name.removesuffix(".mcap") + ".anchors.yaml")


def load_anchors(path: Path) -> AnchorMap:
    """The anchors in a file.

    Raises:
        ParameterError: it cannot be read, or is not as `positioning.anchors` says.
    """
    data = read_bounded(path, MAX_TEXT, ParameterError, "an anchors file, as docs/positioning.md shows")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ParameterError("not a text file", where=str(path), valid="YAML in UTF-8") from error
    return parse_anchors(text, str(path))


def save_anchors(path: Path, anchors: AnchorMap, comment: str = "", *, force: bool = False) -> None:
    """Write an anchors file, whole or not at all.

    Raises:
        ParameterError: it is there and `force` is not given, or it cannot be written.
    """
    if path.exists() and not force:
        raise ParameterError("exists already", where=str(path), valid="--force replaces it")
    write_whole(path, dump_anchors(anchors, comment), ParameterError)


def load_learnt(path: Path, model: Model) -> Offsets:
    """The offsets of pairs that a locator kept in a file, as sure as they are after the time since; none yet = none.

    Raises:
        ParameterError: it cannot be read, is damaged, or holds other offsets than those of pairs.
    """
    if not path.exists():
        return NO_OFFSETS
    found = read_offsets(str(path))
    if found.default or found.anchors or found.tags:
        raise ParameterError(
            "offsets of anchors, tags or all",
            where=str(path),
            valid="those of pairs, as the locator keeps them; give others to the mitigator, as offsets",
        )
    elapsed_s = time.time() - path.stat().st_mtime
    sd = {pair: faded_sd(found.pair_sd.get(pair, model.pair_sd), elapsed_s, model) for pair in found.pairs}
    return Offsets(pairs=found.pairs, pair_sd=sd)


def save_learnt(path: Path, offsets: Offsets) -> None:
    """Keep learnt offsets, the file whole or as it was.

    Raises:
        ParameterError: it cannot be written.
    """
    write_whole(path, dump_offsets(offsets, "learnt by a locator; read again when it starts"), ParameterError)
