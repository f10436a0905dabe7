"""Which model a command works with where none is named."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.errors import UwbMitigationError

if TYPE_CHECKING:
    from uwb_mitigation.model.bundle import Bundle

MOST_LOOKED_AT = 1000

ModelOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE|NAME",
        help="Bundle, or the name of a shipped one; without it `universal`, or `universal_amplitude` where the "
        "first CIR of the recording has no preamble count.",
        show_default=False,
    ),
]


def bundle_for(named: Path | None, recording: Path) -> Bundle:
    """The bundle that is named, or the shipped one that reads the CIRs of a recording; tells if it is not `universal`.

    Raises:
        ModelError: it cannot be loaded.
    """
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import AMPLITUDE, model_path

    if named is None and _lacks_counts(recording):
        console.err.print(f"the CIRs have no preamble count: model {AMPLITUDE}", style="yellow")
        named = Path(AMPLITUDE)
    return load_bundle(model_path(named))


def _lacks_counts(recording: Path) -> bool:
    """Whether the first CIR has none; what cannot be read is for the command to tell, and a damaged CIR tells nothing."""
    from uwb_mitigation.sources.opening import open_recording

    try:
        with open_recording(recording) as source:
            for record in islice(source, MOST_LOOKED_AT):
                if len(record.measurement.cir.samples):
                    return record.measurement.cir.preamble_count <= 0
    except UwbMitigationError:
        pass
    return False
