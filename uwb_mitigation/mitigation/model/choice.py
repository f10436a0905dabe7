"""The choice of a model by the data of a range: the only place with this rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.types.measurement import CirKind


class Choice(NamedTuple):
    """The model of ranges of one kind.

    Attributes:
        model: its index in the sequence of models.
        is_trained: whether it was trained for the radio and the segment; otherwise only offsets are subtracted.
        fits: whether it can correct these ranges.
        kind: the kind, human-readable.
        reason: name and id of the model, or what each one needs if none fits.
    """

    model: int
    is_trained: bool
    fits: bool
    kind: str
    reason: str

    def __str__(self) -> str:
        if self.fits:
            return f"{self.kind}: {self.reason}"
        return f"they are of {self.kind}, and no model in use fits: {self.reason}"


def choose_model(models: Sequence[Bundle], kind: CirKind) -> Choice:
    """Return the first model that can correct ranges of a kind, or else the first one for their radio.

    The choice depends on the range alone and not on earlier ranges of its pair: it is the same live, in batches and in
    recordings, after lost messages and restarts. If one frame of a radio lacks its levels, this frame is corrected
    without them, and the next one with them again.
    """
    misfits = [bundle.card.misfit(kind) for bundle in models]
    trained = [index for index, bundle in enumerate(models) if bundle.card.is_trained_for(kind)]
    if "" in misfits:
        model = misfits.index("")
        reason = f"model {models[model].card.label}, id {models[model].model_id:08x}"
        return Choice(model, True, True, str(kind), reason)
    lacking = "; ".join(f"{models[index].name} {misfits[index]}" for index in trained or range(len(models)))
    return Choice((trained or [0])[0], bool(trained), False, str(kind), lacking)
