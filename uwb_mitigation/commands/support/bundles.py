"""The models that a command has used, and the model of a command that uses only one."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from uwb_mitigation.commands.support import console
from uwb_mitigation.errors import UwbMitigationError

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.mitigation.model.choice import Choice

MAX_RECORDS_READ = 1000


def show_models(models: Mapping[Choice, int]) -> None:
    """Print the number of ranges of each model; warn about ranges that no model fits."""
    for choice, count in models.items():
        if choice.fits:
            console.print_line(f"{count} ranges of {choice}")
        else:
            console.warn(f"{count} ranges are not corrected: {choice}")


def bundle_for(named: Path | None, recording: Path, *, may_be_experimental: bool = True) -> Bundle:
    """Return the named bundle, or the one for the first CIR of a recording (logged unless it is the default).

    Raises:
        ModelError: the bundle cannot be loaded.
    """
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.mitigation.model.choice import CirKind, choose_model
    from uwb_mitigation.mitigation.model.shipped import load_model
    from uwb_mitigation.recordings.formats import open_recording

    models = load_model(named)
    if isinstance(models, Bundle):
        return models
    models = tuple(model for model in models if may_be_experimental or model.card.label == model.name)
    # The command reports the errors of reading.
    with suppress(UwbMitigationError, StopIteration), open_recording(recording) as source:
        cirs = (record.measurement.cir for record in islice(source, MAX_RECORDS_READ))
        choice = choose_model(models, CirKind.of(next(cir for cir in cirs if len(cir))))
        if choice.model:
            console.warn(str(choice))
        return models[choice.model]
    return models[0]
