"""Offsets that anchors, tags or pairs have of their own, where ranges tell them from chance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.joint import JointFit, JointSolver, Links, links_of
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.regressors import Regressors
from uwb_mitigation.positioning.rests import Stretches
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Height

COMMON_SD_M = 1.0
OWN_SD_M = 0.3
"""Offsets as they are known before: of all radios, and by how much one differs."""

LEAST_CONFIDENCE = 0.99
TOLD = 0.6
"""An own offset counts where its deviation is a smaller part of what such offsets scatter by."""

MOST = 0.5
"""So many of them are to count, else none does."""

LEAST_OWN_SD_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Parameters, with their rows for every range, and which ranges err alike.

    Attributes:
        names: of the q parameters.
        rows: float64 (r, q). alike: int (r,), as `Regressors` has it.
        mean, sd: float64 (q,), what is known before.
    """

    names: tuple[str, ...]
    rows: NDArray[np.float64]
    alike: NDArray[np.intp]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]

    @classmethod
    def shared(
        cls, rows: NDArray[np.float64], alike: NDArray[np.intp], known: Regressors, offset: float
    ) -> Columns:
        """An offset of all, about `offset` m, and the regressors, whose rows of these ranges are given."""
        return cls(
            ("offset", *known.names),
            np.column_stack([np.ones(len(rows)), rows]),
            alike,
            np.array([offset, *known.mean]),
            np.array([COMMON_SD_M, *known.sd]),
        )

    def parameters(self, links: Links) -> Parameters:
        """Of links that were made with these rows."""
        return Parameters(links.rows, self.mean, self.sd)

    def with_own(self, columns: dict[str, NDArray[np.bool_]], sd: float) -> Columns:
        """Also an offset of each of those groups of ranges, bool (r,), known to `sd` m."""
        more = np.column_stack([column.astype(float) for column in columns.values()])
        return Columns(
            (*self.names, *columns),
            np.concatenate([self.rows, more], axis=1),
            self.alike,
            np.concatenate([self.mean, np.zeros(len(columns))]),
            np.concatenate([self.sd, np.full(len(columns), sd)]),
        )

    def take(self, kept: NDArray[np.bool_]) -> Columns:
        """Of those ranges, bool (r,)."""
        return replace(self, rows=self.rows[kept], alike=self.alike[kept])


def candidates(found: Stretches) -> list[tuple[str, dict[str, NDArray[np.bool_]]]]:
    """What may have an offset of its own, in the order in which it is tried: {name: which ranges}."""
    row, tag = found.ranges.anchor, found.tag
    tried = [("anchor", {f"anchor {one}": row == one for one in np.unique(row).tolist()})]
    # Of a tag that stays at one place an offset is hardly told from where it is.
    places = {one: len(np.unique(found.of[tag == one])) for one in np.unique(tag).tolist()}
    moves = {one: places[one] > 1 or not found.at_rest[found.of[tag == one][0]] for one in places}
    several = [one for one, does in moves.items() if does]
    if len(several) > 1:
        tried.append(("tag", {f"tag {one}": tag == one for one in several}))
        pairs = {
            f"pair {one} {anchor}": (tag == one) & (row == anchor)
            for one in several
            for anchor in np.unique(row[tag == one]).tolist()
        }
        tried.append(("pair", pairs))
    return tried


def with_own_offsets(
    anchors: AnchorMap,
    found: Stretches,
    solved: Columns,
    columns: dict[str, NDArray[np.bool_]],
    fit: JointFit,
    height: Height | None,
    model: Model,
) -> tuple[Columns | None, JointFit | None, list[str], float]:
    """The parameters with offsets of those columns, where ranges tell them from chance; and whose they do not tell.

    Empirical Bayes: by how much offsets scatter beyond their own uncertainty says how well they are known before. This
    standard deviation, m, is also the error of the common offset where it replaces an own one.
    """
    count = len(columns)

    def fitted(some: Columns) -> JointFit:
        links = links_of(found, some.rows, some.alike, model)
        start = np.concatenate([fit.parameters, np.zeros(len(some.names) - len(fit.parameters))])
        return JointSolver(anchors, links, some.parameters(links), model, height).fit(
            fit.position, start, near=True
        )

    wide = solved.with_own(columns, OWN_SD_M)
    trial = fitted(wide)
    # Of deviations from their mean: that is the offset of all.
    centred = np.eye(count) - 1.0 / count
    own = centred @ trial.parameters[-count:]
    variance = np.diag(centred @ trial.covariance[-count:, -count:] @ centred)
    # What the ranges alone say, the prior taken off again.
    prior = OWN_SD_M**2 * (1.0 - 1.0 / count)
    alone = 1.0 / np.maximum(1.0 / variance - 1.0 / prior, 1e-9)
    free = own * alone / variance
    excess = float(np.sum(free**2 / alone))
    scatter = float(np.sum((free**2 - alone) / alone**2) / np.sum(1.0 / alone**2))
    sd = float(np.sqrt(max(scatter, 0.0)))
    if excess < chi2.ppf(LEAST_CONFIDENCE, max(count - 1, 1)) or scatter < LEAST_OWN_SD_M**2:
        return None, None, [], sd
    # An offset of which the ranges say less than what is known before is not solved for.
    told = np.sqrt(1.0 / (1.0 / alone + 1.0 / scatter)) < TOLD * sd
    untold = [name for name, is_told in zip(columns, told, strict=True) if not is_told]
    if told.mean() < MOST:
        return None, None, [], sd
    better = solved.with_own({name: mask for name, mask in columns.items() if name not in untold}, sd)
    return better, fitted(better), untold, sd
