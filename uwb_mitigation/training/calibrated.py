"""What a site's calibration came to: its figures, the bundle and offsets that it is written as, and what its page shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, format_id
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.preference import MUST_GAIN
from uwb_mitigation.evaluation.site_data import SiteData
from uwb_mitigation.evaluation.site_page import AnchorRow, OffsetRow, SitePage
from uwb_mitigation.files import write_together
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.offsets import Offsets, dump_offsets
from uwb_mitigation.positioning.localised import Localised
from uwb_mitigation.training import site_model
from uwb_mitigation.training.site_model import SiteChoice


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A site's calibration, before it is written.

    Attributes:
        site: what was recorded.
        truth: the topic of the localisation; None = the ranges alone.
        offsets: of the radios, and `pair_m`: {(tag id, anchor id): (offset, standard deviation)}, m.
        level: `pair`, `anchor` or `one`: what has an offset of its own.
        data: the ranges that truth is known of, less the offsets.
        raw_m: float64 (n,), errors of these as measured, against that truth.
        choice: the model.
        notes: what was not told apart, or left out, in words.
        track: float64 (k, 3), where the tags were at `track_of` (k,), the stretches; for a picture.
        network: the factor by which the bundle multiplies the universal network's predictions (0: no network; 1: of a
            fine-tuned network), and the standard deviation of the factor in the joint solution (0: given).
        line: the same of the received power, m/dB.
        localised: what `truth` needed.
        places: {tag id: position} of tags at rest; {`tag id #number`: position} of each place of one that was at several.
        outliers: the number of ranges that were left out of all figures because their errors are implausible.
        common_sd_m: the standard deviation of the mean offset, which the evaluation has in common with the offsets; 0 with
            ground truth.
        position_scatter_m: the scatter of positions between tracks without one anchor, raw and calibrated; NaN = unknown.
    """

    site: SiteData
    truth: str | None
    offsets: Offsets
    pair_m: dict[tuple[int, int], tuple[float, float]]
    level: str
    data: Dataset
    raw_m: NDArray[np.float64]
    choice: SiteChoice
    notes: tuple[str, ...]
    track: NDArray[np.float64]
    track_of: NDArray[np.intp]
    network: tuple[float, float]
    line: tuple[float, float]
    localised: Localised | None
    places: dict[str, tuple[float, float, float]]
    outliers: int
    common_sd_m: float
    position_scatter_m: tuple[float, float]

    @property
    def raw_mae_m(self) -> float:
        """MAE of the ranges as measured."""
        return float(np.abs(self.raw_m).mean())

    @property
    def calibrated_mae_m(self) -> float:
        """MAE that the chosen model leaves on stretches and anchors that it was not fitted to."""
        return self.choice.mae()[self.choice.chosen]

    @property
    def harms(self) -> bool:
        """Whether the held-out error is not lower than the raw one by `MUST_GAIN`, or positions scatter more."""
        raw, calibrated = self.position_scatter_m
        return self.calibrated_mae_m > (1.0 - MUST_GAIN) * self.raw_mae_m or calibrated > raw

    @property
    def sure_gain(self) -> float:
        """The share by which the held-out error is lower at least, if the mean offset is wrong by two standard deviations.

        Without ground truth the held-out ranges are compared with a track that contains the error of the mean offset.
        """
        left = self.choice.held_out[self.choice.chosen]
        by = (-2.0 * self.common_sd_m, 0.0, 2.0 * self.common_sd_m)
        return min(
            1.0 - float(np.abs(left + wrong).mean() / max(np.abs(self.raw_m + wrong).mean(), 1e-9))
            for wrong in by
        )

    def sentence(self) -> str:
        """The result in one sentence."""
        errors = (
            f"{self.raw_mae_m:.3f} m raw, {self.calibrated_mae_m:.3f} m calibrated ({self.choice.chosen})"
        )
        if self.truth is not None:
            what = f"Held-out range errors against {self.truth}: {errors}"
        else:
            what = f"Held-out range residuals against the other anchors (not ground truth): {errors}"
            if not math.isnan(self.position_scatter_m[0]):
                raw, calibrated = self.position_scatter_m
                what += f"; positions without one anchor scatter by {raw:.3f} m raw, {calibrated:.3f} m calibrated"
        if self.harms:
            return f"{what}: no gain."
        if (gain := self.sure_gain) <= 0.0:
            return f"{what}. The gain is smaller than its uncertainty."
        return f"{what}: at least {gain:.0%} less."

    def as_json(self) -> dict[str, object]:
        """The result of `uwb-mitigation calibrate`."""
        prior = self.choice.prior
        return {
            "offsets_m": {f"{tag}-{anchor}": value for (tag, anchor), (value, _) in self.pair_m.items()},
            "offset_sd_m": {f"{tag}-{anchor}": sd for (tag, anchor), (_, sd) in self.pair_m.items()},
            "offsets_of": self.level,
            "raw_mae_m": self.raw_mae_m,
            "calibrated_mae_m": self.calibrated_mae_m,
            "truth": self.truth or "none",
            "refused": None,
            "chosen": self.choice.chosen,
            "candidates": self.choice.mae(),
            "ranges": sum(map(len, self.site.tags)),
            "labelled": len(self.data),
            "outliers": self.outliers,
            "position_scatter_m": [None if math.isnan(value) else value for value in self.position_scatter_m],
            "network_factor": list(self.network),
            "line": {
                "offset_m": prior.offset_m,
                "per_rx_power": prior.per_rx_power,
                "per_power_gap": prior.per_power_gap,
            },
            "places": {name: list(place) for name, place in self.places.items()},
            "notes": list(self.notes),
            "left_out": dict(self.site.left_out),
            "localisation": None if self.localised is None else self.localised.as_json(),
        }


def write(output: Path, result: Calibrated, source: Bundle, name: str) -> tuple[Bundle, Path]:
    """The bundle, and the offsets beside it as `X.offsets.yaml`, together (`write_together`).

    Args:
        name: of the recordings, for people.

    Raises:
        ModelError: they cannot be written.
    """
    how = "without truth" if result.truth is None else f"with truth from {result.truth}"
    mae = result.choice.mae()
    told = {
        "data": f"{name}, calibrated {how}",
        "calibrated": how,
        "chosen": result.choice.chosen,
        "measurements": len(result.data),
        "configurations": len(result.data.names),
        "split": "held out: stretches of the track, and anchors",
        "started_from": f"{source.model_id:08x}",
        "recipe": {"line": result.choice.prior.needs_power, "network": result.choice.network is not None},
        "metrics_m": {
            row: {"mae": round(value, 4)} for row, value in {"raw": result.raw_mae_m, **mae}.items()
        },
    }
    bundle, data = site_model.bundle_of(output, result.data, result.choice, source, result.raw_m, told)
    beside = offsets_file(output)
    comment = (
        f"Offsets of the radios, m, beside model {bundle.model_id:08x} ({output.name}): use both together.\n"
        f"Found by uwb-mitigation calibrate in {name}, {how}."
    )
    write_together({output: data, beside: dump_offsets(result.offsets, comment)}, ModelError)
    return bundle, beside


def shown(result: Calibrated, name: str) -> SitePage:
    """What the page of a calibration shows."""
    left = result.choice.held_out[result.choice.chosen]
    assert result.data.anchors is not None
    rows = []
    for anchor in result.site.anchors.anchors:
        own = result.data.anchors == anchor.id
        if own.any():
            before, after = (np.abs(error[own]) for error in (result.raw_m, left))
            rows.append(AnchorRow(str(anchor), int(own.sum()), *map(float, (before.mean(), after.mean()))))
    offsets = [
        OffsetRow(format_id(tag), format_id(anchor), *pair) for (tag, anchor), pair in result.pair_m.items()
    ]
    facts = []
    if result.localised is not None:
        told = result.localised
        arm = "; ".join(", ".join(f"{value:.3f}" for value in own) for own in told.lever_arm_m)
        facts.append(
            f"Localisation {result.truth}: time offset {told.time_offset_s:.3f} s, lever arm {arm} m."
        )
    if result.network[0] and result.network[1]:
        facts.append(
            f"The universal network's predictions count {result.network[0]:.2f} +- {result.network[1]:.2f} times."
        )
    if result.line[1]:
        facts.append(
            f"A dB more received power: {result.line[0] * 100:.2f} +- {result.line[1] * 100:.2f} cm of range."
        )
    tracks = [result.track[result.track_of == one][:, :2] for one in np.unique(result.track_of)]
    return SitePage(
        name,
        result.sentence(),
        tuple(facts),
        result.notes,
        tuple((str(one), one.position[0], one.position[1]) for one in result.site.anchors.anchors),
        tuple(tracks),
        tuple(rows),
        tuple(offsets),
        tuple({"raw": result.raw_mae_m, **result.choice.mae()}.items()),
        result.choice.chosen,
    )


def offsets_file(bundle: Path) -> Path:
    """Where the offsets of a site's bundle lie."""
    return bundle.with_suffix(".offsets.yaml")
