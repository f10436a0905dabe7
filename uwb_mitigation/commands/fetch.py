"""`uwb-mitigation data fetch`: download a published data set."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption


class DatasetName(str, enum.Enum):
    """The data sets that can be fetched."""

    DEEPUWB = "deepuwb"


def fetch(
    name: Annotated[DatasetName, typer.Argument(metavar="NAME", help="The data set: deepuwb.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Where to; by default NAME.pkl.")
    ] = None,
    url: Annotated[
        str | None, typer.Option("--url", metavar="MIRROR", help="Download from here in place of the DOI.")
    ] = None,
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", metavar="HEX", help="Check against this in place of Zenodo's checksum."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE if it is another file.")] = False,
    json: JsonOption = None,
) -> None:
    """Download and check a data set that `data import` reads."""
    from uwb_mitigation.sources import deepuwb
    from uwb_mitigation.sources.download import download

    target = output or Path(f"{name.value}.pkl")
    with console.progress() as bar:
        task = bar.add_task(f"fetching {name.value}", total=None)
        result = download(
            deepuwb.PUBLISHED,
            target,
            lambda done, total: bar.update(task, completed=done, total=total),
            url=url,
            checksum=None if sha256 is None else f"sha256:{sha256}",
            force=force,
        )
    size = target.stat().st_size
    told = f"Wrote {size} bytes to {target}" if result.fetched else f"{target} is there already"
    console.out.print(f"{told}; {result.checksum} is right.", markup=False, soft_wrap=True)
    console.write_json(
        json,
        {
            "output": str(target),
            "bytes": size,
            "checksum": result.checksum,
            "url": result.url,
            "fetched": result.fetched,
        },
    )
