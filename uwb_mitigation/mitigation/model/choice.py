"""The choice of a model by the data of a range: the only place with this rule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.types.measurement import Cir, Encoding, RadioType, RangeColumns, Segment


class CirKind(NamedTuple):
    """Properties of a CIR that decide which model can correct its range; the fields are those of `Cir`.

    `samples`: their number in time; 0: no CIR. `has_levels`: both levels are known.
    """

    radio: RadioType
    segment: Segment
    samples: int
    has_preamble_count: bool
    has_levels: bool

    @classmethod
    def of(cls, cir: Cir) -> CirKind:
        """Return the kind of a CIR."""
        return cls(cir.radio, cir.segment, len(cir), cir.preamble_count > 0, math.isfinite(cir.power_gap_db))

    @property
    def source(self) -> tuple[RadioType, Segment]:
        """Radio and segment; recordings of earlier versions and of other programs contain only the DW1000's preamble."""
        is_unknown = self.radio is RadioType.UNKNOWN and self.segment is Segment.UNKNOWN
        return (RadioType.DW1000, Segment.IPATOV) if is_unknown else (self.radio, self.segment)

    def __str__(self) -> str:
        if not self.samples:
            return f"{self.radio.name} without CIR"
        radio, segment = self.source
        text = f"{radio.name} {segment.name}" + (" (assumed)" if radio is not self.radio else "")
        available = {"preamble count": self.has_preamble_count, "levels": self.has_levels}
        missing = [name for name, is_known in available.items() if not is_known]
        return f"{text} {'without' if missing else 'with'} {' and '.join(missing or available)}"


def kinds_of(ranges: RangeColumns) -> dict[CirKind, list[int]]:
    """Return the kinds of the CIRs of ranges, and the rows of each."""
    samples = ranges.samples.shape[1] // (2 if ranges.encoding == Encoding.COMPLEX_INT16 else 1)
    levels = ranges.rx_power_dbm.tolist(), ranges.first_path_power_dbm.tolist()
    rows: dict[tuple[bool, bool], list[int]] = {}
    # A loop over Python numbers: for a live range, a batch of one, it is faster than operations on arrays.
    for row, (count, rx, first_path) in enumerate(zip(ranges.preamble_count.tolist(), *levels, strict=True)):
        rows.setdefault((count > 0, math.isfinite(rx - first_path)), []).append(row)
    return {
        CirKind(ranges.radio, ranges.segment, samples, *available): indices
        for available, indices in rows.items()
    }


def is_trained_for(card: ModelCard, kind: CirKind) -> bool:
    """Return whether a network was trained for the radio and the segment of CIRs."""
    radio, segment = kind.source
    return radio in card.radios and (segment in card.segments or not kind.samples)


def misfit(card: ModelCard, kind: CirKind) -> str:
    """Return why a model cannot correct ranges with CIRs of a kind; empty: it can."""
    samples, needs_levels = card.preprocessing.samples, card.linear_bias.needs_power
    if not is_trained_for(card, kind):
        return f"was trained for {card.source}"
    if card.needs_cir:
        needs_levels |= card.ood_bands is not None and card.ood_bands.needs_levels
        if kind.samples < samples:
            return f"needs a CIR of {samples} samples"
        if card.preprocessing.scaling is Scaling.PREAMBLE and not kind.has_preamble_count:
            return "needs the preamble count"
    return "" if kind.has_levels or not needs_levels else "needs the levels"


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
    misfits = [misfit(bundle.card, kind) for bundle in models]
    trained = [index for index, bundle in enumerate(models) if is_trained_for(bundle.card, kind)]
    if "" in misfits:
        model = misfits.index("")
        reason = f"model {models[model].card.label}, id {models[model].model_id:08x}"
        return Choice(model, True, True, str(kind), reason)
    lacking = "; ".join(f"{models[index].name} {misfits[index]}" for index in trained or range(len(models)))
    return Choice((trained or [0])[0], bool(trained), False, str(kind), lacking)
