"""Offsets of radios, and what else all ranges share, from ranges to known anchors alone: nobody knows where the tags were.

What geometry cannot tell apart is not solved for: an offset of its own has an anchor, a tag or a pair only where the
ranges say so by more than their own uncertainty; otherwise all share one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Shape, shape
from uwb_mitigation.positioning.joint import FAR_S, JointFit, JointSolver, Links, links_of
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.regressors import Regressors
from uwb_mitigation.positioning.rests import Stretches, stretches
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.starting import first_positions, likely_offset
from uwb_mitigation.positioning.tracks import Ranges

COMMON_SD_M = 1.0
OWN_SD_M = 0.3
"""Offsets as they are known before: of all radios, and by how much one differs."""

NETWORK_SD = 0.03
"""How far the universal network's predictions may be from what the site's errors are, as a factor around 1. Little: a
predictor that errs itself draws a free factor below 1, and what it then leaves goes into the offsets."""

SLOPE_SD = 0.1
"""m/dB."""

LEAST_CONFIDENCE = 0.99
TOLD = 0.6
"""An own offset counts where its deviation is a smaller part of what such offsets scatter by."""

UNTOLD_M = 0.2
"""An offset that is known no better is as good as unknown: antenna delays that nobody calibrated differ by as much."""

MOST = 0.5
"""So many of them are to count, else none does."""

LEAST_OWN_SD_M = 0.02
MOVES_M = 1.0
LEAST_NEW = 20
"""Ranges that say something new, beside those that a place at rest takes."""

MIRRORED = 4.5
"""Mirror images are as good where one is not less likely than the other by e^-4.5."""

CONTRADICTS_M, CONTRADICTS = 0.12, 2.0
"""Anchors contradict each other where ranges scatter so much; the one without which they scatter less by such a factor,
and by as much less than without any other, is to blame."""

MOST_REFITS = 8

MODEL = Model(long=1.5, short=1.5)
"""Of errors about as often too long as too short, once offsets and predictions are taken off: what is doubted sooner on
one side than on the other would pull an offset to that other."""


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """What was found.

    Attributes:
        stretches, links, fit: as in `rests` and `joint`.
        names: of the parameters: `offset`, `anchor ROW`, `tag NUMBER`, `pair NUMBER ROW`, and the regressors'.
        level: `pair`, `anchor` or `one`: what has an offset of its own.
        not_told: what geometry cannot tell apart, and what was left out, in words.
        tag_ids: of the tags.
        pseudo_m, pseudo_sd_m: float64 (r,), in the order of `stretches.ranges`: how far each range's anchor is from where
            the *other* anchors see the tag, and how well that is known; NaN = not at all.
    """

    stretches: Stretches
    links: Links
    fit: JointFit
    names: tuple[str, ...]
    level: str
    not_told: tuple[str, ...]
    tag_ids: tuple[int, ...]
    anchors: AnchorMap
    pseudo_m: NDArray[np.float64]
    pseudo_sd_m: NDArray[np.float64]
    untold_m: float = 0.0

    def value(self, name: str) -> tuple[float, float]:
        """A parameter and its standard deviation; (0, 0) where it was not solved for."""
        if name not in self.names:
            return 0.0, 0.0
        at = self.names.index(name)
        return float(self.fit.parameters[at]), float(np.sqrt(self.fit.covariance[at, at]))

    def pair(self, tag: int, row: int) -> tuple[float, float]:
        """The offset of a tag (its number) and an anchor (its row), m, and its standard deviation."""
        wanted = {"offset", f"anchor {row}", f"tag {tag}", f"pair {tag} {row}"}
        at = [i for i, name in enumerate(self.names) if name in wanted]
        # How well anchors were measured bounds it: an anchor's misplacement looks like an offset, its mean over all
        # directions from which the tag saw it being about half of it in variance.
        placed = (
            self.anchors.sd[row] ** 2 / 2.0
            if len(at) > 1
            else np.mean(self.anchors.sd**2) / len(self.anchors)
        )
        variance = self.fit.covariance[np.ix_(at, at)].sum() + placed + self.untold_m**2
        return float(self.fit.parameters[at].sum()), float(np.sqrt(variance))

    def pairs(self) -> list[tuple[int, int]]:
        """(tag number, anchor row) of all pairs that there are ranges of."""
        found = np.unique(np.stack([self.stretches.tag, self.stretches.ranges.anchor]), axis=1).T
        return [(int(tag), int(row)) for tag, row in found]


def calibrate(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    regressors: Regressors | None = None,
    *,
    height: Height | None = None,
    area: Area | None = None,
    model: Model | None = None,
) -> SelfCalibration:
    """Solve for all of it.

    Args:
        anchors: where they are.
        tags: what was recorded of each, of unknown places; each in the order of time.
        regressors: as many rows as there are ranges.
        height: of all tags, where it stays the same. area: where tags can be.

    Raises:
        DatasetError: geometry does not tell; says what is missing.
    """
    model = model or MODEL
    tags = list(tags)
    known = regressors or Regressors.none(sum(map(len, tags)))
    check_anchors(anchors, np.unique(np.concatenate([one.anchor for one in tags])), height)
    told: list[str] = []
    found = stretches(tags, anchors, height, model)
    begins = np.cumsum([0, *map(len, tags)])
    of_range = begins[found.tag] + found.row
    rows, alike = known.rows[of_range], known.alike[of_range]
    expected = rows @ known.mean
    offset = likely_offset(anchors, found, expected, height, area, model)
    position, placed = first_positions(anchors, tags, found, expected + offset, height, area, model)
    if not placed.all():
        told.append(
            f"{int((~placed).sum())} of {len(placed)} stretches left out: no place of the tag can be told"
        )
    if not placed.any():
        raise DatasetError(
            "no place of a tag can be told",
            valid="four anchors or more that hear a tag at once, --height or --area",
        )
    kept = placed[found.of]
    found, rows, alike = found.keep(placed), rows[kept], alike[kept]
    solved = _Columns.shared(rows, alike, known, offset)
    links = links_of(found, solved.rows, solved.alike, model)
    # Knots of stretches that were left out are gone from the positions, too.
    fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(position)
    ambiguous = _mirrored(anchors, links, fit, height, area, model)
    if ambiguous.any():
        told.append(
            f"{int(ambiguous.sum())} of {len(ambiguous)} stretches left out: their mirror images are as good"
        )
        if ambiguous.all():
            raise DatasetError(
                "the track has two mirror images, and either explains the ranges as well",
                valid="--height or --area to say which, or an anchor beside the others' line (above or below their plane)",
            )
        kept, knots = ~ambiguous[found.of], ~ambiguous[links.knot_stretch]
        found, solved, position = found.keep(~ambiguous), solved.take(kept), fit.position[knots]
        links = links_of(found, solved.rows, solved.alike, model)
        fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(position)
    _check_motion(links, fit, height)
    level = "one"
    tried = _own_offsets(found)
    untold = 0.0
    if float(np.sqrt(fit.covariance[0, 0])) > UNTOLD_M:
        untold = float(np.sqrt(fit.covariance[0, 0]))
        told.append("an offset of all: not told apart from where the tags were, and taken as 0")
        # Without it nothing says how long any range truly is: offsets of their own would be its errors.
        tried = []
        solved = replace(solved, mean=np.array([0.0, *solved.mean[1:]]), sd=np.array([1e-4, *solved.sd[1:]]))
        links = links_of(found, solved.rows, solved.alike, model)
        start = np.array([0.0, *fit.parameters[1:]])
        fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(fit.position, start)
    for group, columns in tried:
        richer, better, shared = _with_own(anchors, found, solved, columns, fit, height, model)
        if richer is None or better is None:
            told.append(f"offsets of {group}s of their own: not told from chance, so that all share one")
            break
        solved, fit, level = richer, better, "pair" if group != "anchor" else "anchor"
        if shared:
            told.append(f"{', '.join(shared)}: not told apart from the others, whose offset counts")
    if level == "anchor" and len(np.unique(found.tag)) == 1:
        # Of one tag an anchor's offset is the pair's.
        level = "pair"
    links = links_of(found, solved.rows, solved.alike, model)
    fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(
        fit.position, fit.parameters
    )
    _check_contradiction(anchors, links, fit, height, model)
    pseudo, sd = _by_others(anchors, found, links, fit, height, model)
    return SelfCalibration(
        found,
        links,
        fit,
        solved.names,
        level,
        tuple(told),
        tuple(one.tag_id for one in tags),
        anchors,
        pseudo,
        sd,
        untold,
    )


def check_anchors(anchors: AnchorMap, used: NDArray[np.intp], height: Height | None) -> None:
    """Refuse anchors that cannot tell.

    Args:
        used: rows of those that were heard.

    Raises:
        DatasetError: too few, or all on a line (without a height: in a plane).
    """
    needed = 4 if height is not None else 5
    if len(used) < needed:
        raise DatasetError(
            f"{len(used)} anchors were heard",
            valid=f"{needed} or more" + (", or four and --height" if height is None else ""),
        )
    position = anchors.position[used]
    if height is not None:
        position = position * (1.0, 1.0, 0.0)
    kind = shape(position)
    if kind in (Shape.POINT, Shape.LINE):
        raise DatasetError("the anchors are all on a line", valid="one or more beside it")
    if height is None and kind is Shape.PLANE:
        raise DatasetError(
            "the anchors are all in a plane: mirrored at it, the track explains the ranges as well",
            valid="--height of the tag, or an anchor above or below that plane",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Parameters, with their rows for every range, and which ranges err alike."""

    names: tuple[str, ...]
    rows: NDArray[np.float64]
    alike: NDArray[np.intp]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]

    @classmethod
    def shared(
        cls, rows: NDArray[np.float64], alike: NDArray[np.intp], known: Regressors, offset: float
    ) -> _Columns:
        return cls(
            ("offset", *known.names),
            np.column_stack([np.ones(len(rows)), rows]),
            alike,
            np.array([offset, *known.mean]),
            np.array([COMMON_SD_M, *known.sd]),
        )

    def parameters(self, links: Links) -> Parameters:
        return Parameters(links.rows, self.mean, self.sd)

    def with_own(self, columns: dict[str, NDArray[np.bool_]], sd: float) -> _Columns:
        more = np.column_stack([column.astype(float) for column in columns.values()])
        return _Columns(
            (*self.names, *columns),
            np.concatenate([self.rows, more], axis=1),
            self.alike,
            np.concatenate([self.mean, np.zeros(len(columns))]),
            np.concatenate([self.sd, np.full(len(columns), sd)]),
        )

    def take(self, kept: NDArray[np.bool_]) -> _Columns:
        return replace(self, rows=self.rows[kept], alike=self.alike[kept])


def _own_offsets(found: Stretches) -> list[tuple[str, dict[str, NDArray[np.bool_]]]]:
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


def _with_own(
    anchors: AnchorMap,
    found: Stretches,
    solved: _Columns,
    columns: dict[str, NDArray[np.bool_]],
    fit: JointFit,
    height: Height | None,
    model: Model,
) -> tuple[_Columns | None, JointFit | None, list[str]]:
    """The parameters with offsets of those columns, where ranges tell them from chance; and whose they do not tell.

    Empirical Bayes: by how much offsets scatter beyond their own uncertainty says how well they are known before.
    """
    count = len(columns)

    def fitted(some: _Columns) -> JointFit:
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
    if excess < chi2.ppf(LEAST_CONFIDENCE, max(count - 1, 1)) or scatter < LEAST_OWN_SD_M**2:
        return None, None, []
    sd = float(np.sqrt(scatter))
    # An offset of which the ranges say less than what is known before is not solved for.
    told = np.sqrt(1.0 / (1.0 / alone + 1.0 / scatter)) < TOLD * sd
    untold = [name for name, is_told in zip(columns, told, strict=True) if not is_told]
    if told.mean() < MOST:
        return None, None, []
    better = solved.with_own({name: mask for name, mask in columns.items() if name not in untold}, sd)
    return better, fitted(better), untold


def _mirrored(
    anchors: AnchorMap, links: Links, fit: JointFit, height: Height | None, area: Area | None, model: Model
) -> NDArray[np.bool_]:
    """Which stretches are explained as well by what they would be on the anchors' other side."""
    used = anchors.position[np.unique(links.anchor)]
    axes = slice(0, 2) if height is not None else slice(0, 3)
    centre = used.mean(axis=0)
    normal = np.zeros(3)
    normal[axes] = np.linalg.svd(used[:, axes] - centre[axes])[2][-1]
    image = fit.position - 2.0 * ((fit.position - centre) @ normal)[:, None] * normal
    silent = replace(
        links, range_m=links.range_m - links.rows @ fit.parameters, rows=np.zeros((len(links), 0))
    )
    nothing = Parameters(silent.rows, np.zeros(0), np.zeros(0))
    try:
        other = JointSolver(anchors, silent, nothing, model, height, fit.scale_m).fit(image)
    except DatasetError:
        return np.zeros(len(fit.stretch_loss), np.bool_)
    apart = np.linalg.norm(other.position - fit.position, axis=1) > MOVES_M
    if area is not None:
        apart &= area.holds(other.position)
    share = np.bincount(links.knot_stretch, apart) / np.bincount(links.knot_stretch)
    return (other.stretch_loss - fit.stretch_loss < MIRRORED) & (share > 0.5)


def _check_motion(links: Links, fit: JointFit, height: Height | None) -> None:
    spread = float(np.linalg.norm(np.ptp(fit.position, axis=0)))
    if spread < MOVES_M:
        raise DatasetError(
            f"the tag moves by {spread:.1f} m only: its place is not told from its radio's offset",
            valid=f"a drive of {MOVES_M:g} m or more, or tags at several places",
        )
    places = int(links.at_rest.sum())
    new = float(links.share.sum())
    needed = LEAST_NEW + 1.5 * (2 if height is not None else 3) * places
    if new < needed:
        raise DatasetError(
            f"{len(links.of)} ranges that say {new:.0f} things: too few",
            valid=f"{needed:.0f} or more: a longer drive, or more anchors at each place",
        )


def _fixed(links: Links, fit: JointFit) -> Links:
    """The same links, what the parameters explain taken off."""
    return replace(links, range_m=links.range_m - links.rows @ fit.parameters, rows=np.zeros((len(links), 0)))


def _without(
    anchors: AnchorMap,
    links: Links,
    fit: JointFit,
    rows: NDArray[np.intp],
    height: Height | None,
    model: Model,
) -> JointFit:
    """The places without those anchors, the parameters as they are."""
    rest = _fixed(links, fit).without(np.isin(links.anchor, rows))
    nothing = Parameters(rest.rows, np.zeros(0), np.zeros(0))
    return JointSolver(anchors, rest, nothing, model, height, fit.scale_m, fit.position).fit(
        fit.position, near=True
    )


def _check_contradiction(
    anchors: AnchorMap, links: Links, fit: JointFit, height: Height | None, model: Model
) -> None:
    """Raises `DatasetError` where anchors contradict each other; names the one without which they would not."""

    def scatter(one: JointFit) -> float:
        return float(np.sqrt(np.mean(np.minimum(np.abs(one.residual_m), 5.0) ** 2)))

    used = np.unique(links.anchor)
    if scatter(fit) < CONTRADICTS_M or len(used) < 4:
        return
    left = np.array(
        [scatter(_without(anchors, links, fit, used[k : k + 1], height, model)) for k in range(len(used))]
    )
    order = np.argsort(left)
    best, next_best = left[order[0]], left[order[1]]
    name = anchors.anchors[used[order[0]]]
    if best * CONTRADICTS < min(scatter(fit), next_best):
        raise DatasetError(
            f"anchor {name} contradicts the others: with it ranges scatter by {scatter(fit):.2f} m, without it by {best:.2f} m",
            valid="its true place in the anchors file (`uwb-mitigation survey` finds it)",
        )


def _by_others(
    anchors: AnchorMap, found: Stretches, links: Links, fit: JointFit, height: Height | None, model: Model
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For each of the ranges how far its anchor is from where the others see the tag, and the deviation of that."""
    distance = np.full(len(found.ranges), np.nan)
    sd = np.full(len(found.ranges), np.nan)
    used = np.unique(links.anchor)
    # Of many anchors a few are left out at once: enough others remain.
    for part in (used[k::MOST_REFITS] for k in range(min(MOST_REFITS, len(used)))):
        try:
            seen = _without(anchors, links, fit, part, height, model)
            covariance = seen.covariances()
        except (DatasetError, np.linalg.LinAlgError):
            continue
        own = np.isin(links.anchor, part)
        heard = np.zeros(len(links.time_s), np.bool_)
        heard[links.knot[~own]] = True
        knot, ahead = links.knot[own], links.ahead_s[own]
        away = (
            seen.position[knot] + ahead[:, None] * seen.velocity[knot] - anchors.position[links.anchor[own]]
        )
        length = np.maximum(np.linalg.norm(away, axis=1), 0.05)
        unit = away / length[:, None]
        known = np.sqrt(np.einsum("ni,nij,nj->n", unit, covariance[knot], unit))
        known[~(_nearest_heard_s(links, heard)[knot] <= FAR_S)] = np.nan
        of_link, sd_of = np.full(len(links), np.nan), np.full(len(links), np.nan)
        of_link[own], sd_of[own] = length, known
        mine = np.isin(found.ranges.anchor, part)
        distance[mine], sd[mine] = of_link[links.of[mine]], sd_of[links.of[mine]]
    return distance, sd


def _nearest_heard_s(links: Links, heard: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How far in time each knot is from one of its stretch that still has ranges; inf = there is none."""
    # Stretches set so far apart that none is near another.
    time = links.time_s + links.knot_stretch * (float(links.time_s.max(initial=0.0)) + 1e6)
    there = time[heard]
    if not len(there):
        return np.full(len(time), np.inf)
    after = (
        np.clip(np.searchsorted(there, time), 1, len(there) - 1)
        if len(there) > 1
        else np.zeros(len(time), int)
    )
    nearest: NDArray[np.float64] = np.minimum(np.abs(time - there[after]), np.abs(time - there[after - 1]))
    return nearest
