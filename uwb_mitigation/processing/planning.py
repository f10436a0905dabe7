"""Which bags to process, and where each goes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from uwb_mitigation.bag.rosbag2 import described_files
from uwb_mitigation.errors import ParameterError, RecordingError


@dataclass(frozen=True, slots=True)
class Planned:
    """A bag and its output; `alone`: it is the only one."""

    source: Path
    output: Path
    alone: bool


def plan(sources: Sequence[Path], output: Path) -> list[Planned]:
    """Every bag in `sources` with its output.

    One bag goes to `output` itself. Several, or a folder of bags, go into the folder `output`, under
    their names and in the subfolders that they were found in. Outputs of an earlier run that lie within
    a source folder are left out.

    Raises:
        RecordingError: a source is absent, or a folder without a bag.
        ParameterError: `output` is a file where a folder is wanted, or two bags would go to one place.
    """
    if len(sources) == 1 and _is_one_bag(sources[0]):
        return [Planned(sources[0], output, True)]
    if output.suffix == ".mcap" or (output.exists() and not output.is_dir()):
        raise ParameterError(
            "one file for several bags", where=str(output), valid="a folder, which need not exist"
        )
    planned: dict[Path, Planned] = {}
    for source in sources:
        if _is_one_bag(source):
            found = [(source, Path(source.resolve().name))]
        else:
            # Of one folder its contents are mirrored, of several also their names.
            root = Path() if len(sources) == 1 else Path(source.resolve().name)
            found = [(bag, root / bag.relative_to(source)) for bag in _bags(source, output.resolve())]
            if not found:
                raise RecordingError("the folder holds no MCAP bag", where=str(source))
        for bag, name in found:
            place = output / name
            if place in planned:
                raise ParameterError(
                    f"{planned[place].source} and {bag} have one name",
                    where=str(place),
                    valid="different names, or one run for each",
                )
            planned[place] = Planned(bag, place, False)
    return list(planned.values())


def _is_one_bag(path: Path) -> bool:
    """Whether a path is a file, or a folder that its `metadata.yaml` describes as one bag."""
    if not path.exists():
        raise RecordingError("no such file or folder", where=str(path))
    if not path.is_dir():
        return True
    described = described_files(path)
    return described is not None and {file.name for file in path.glob("*.mcap")} <= set(described)


def _bags(folder: Path, without: Path) -> Iterator[Path]:
    """The bags below a folder that is no bag itself."""
    for place, folders, files in os.walk(folder):
        here = Path(place)
        below = []
        for name in sorted(folders):
            path = here / name
            if path.resolve() == without:
                continue
            if _may_be_one_bag(path):
                yield path
            else:
                below.append(name)
        folders[:] = below
        yield from (here / name for name in sorted(files) if name.endswith(".mcap"))


def _may_be_one_bag(path: Path) -> bool:
    try:
        return _is_one_bag(path)
    except RecordingError:
        # Processing it fails in the same way, and is reported without stopping the rest.
        return True
