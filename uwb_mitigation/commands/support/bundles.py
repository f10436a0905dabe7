"""Default model of a command."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.errors import UwbMitigationError

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.model.bundle import Bundle

MAX_RECORDS_READ = 1000

ModelOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE|NAME",
        help="Bundle, or the name of a shipped one. Default: `universal`, or `universal_amplitude` if the "
        "first CIR of the recording has no preamble count.",
        show_default=False,
    ),
]


def bundle_for(named: Path | None, recording: Path) -> Bundle:
    """Return the named bundle, or the shipped one (logged unless `universal`) that can read a recording's CIRs.

    Raises:
        ModelError: the bundle cannot be loaded.
    """
    from uwb_mitigation.mitigation.model.shipped import AMPLITUDE, load_model

    if named is None and _lacks_counts(recording):
        console.err.print(f"the CIRs have no preamble count: using the model {AMPLITUDE}", style="yellow")
        named = Path(AMPLITUDE)
    return load_model(named)


def _lacks_counts(recording: Path) -> bool:
    """Return whether the first CIR has no preamble count; False if it is damaged. The command reports read errors."""
    from uwb_mitigation.recordings.formats import open_recording

    try:
        with open_recording(recording) as source:
            for record in islice(source, MAX_RECORDS_READ):
                if len(record.measurement.cir.samples):
                    return record.measurement.cir.preamble_count <= 0
    except UwbMitigationError:
        pass
    return False
