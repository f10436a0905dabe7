"""What geometry cannot tell: refused in words, with what is missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Shape, shape
from uwb_mitigation.positioning.joint import JointFit, JointSolver, Links
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.other_anchors import less_parameters, without
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Area, Height

MOVES_M = 1.0
LEAST_NEW = 20
"""Ranges that say something new, beside those that a place at rest takes."""

MIRRORED = 4.5
"""Mirror images are as good where one is not less likely than the other by e^-4.5."""

CONTRADICTS_M, CONTRADICTS = 0.12, 2.0
"""Anchors contradict each other where ranges scatter so much; the one without which they scatter less by such a factor,
and by as much less than without any other, is to blame."""


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


def mirrored(
    anchors: AnchorMap, links: Links, fit: JointFit, height: Height | None, area: Area | None, model: Model
) -> NDArray[np.bool_]:
    """Which stretches are explained as well by what they would be on the anchors' other side."""
    used = anchors.position[np.unique(links.anchor)]
    axes = slice(0, 2) if height is not None else slice(0, 3)
    centre = used.mean(axis=0)
    normal = np.zeros(3)
    normal[axes] = np.linalg.svd(used[:, axes] - centre[axes])[2][-1]
    image = fit.position - 2.0 * ((fit.position - centre) @ normal)[:, None] * normal
    silent = less_parameters(links, fit)
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


def check_motion(links: Links, fit: JointFit, height: Height | None) -> None:
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


def check_contradiction(
    anchors: AnchorMap, links: Links, fit: JointFit, height: Height | None, model: Model
) -> None:
    """Raises `DatasetError` where anchors contradict each other; names the one without which they would not."""

    def scatter(one: JointFit) -> float:
        return float(np.sqrt(np.mean(np.minimum(np.abs(one.residual_m), 5.0) ** 2)))

    used = np.unique(links.anchor)
    if scatter(fit) < CONTRADICTS_M or len(used) < 4:
        return
    left = np.array(
        [scatter(without(anchors, links, fit, used[k : k + 1], height, model)) for k in range(len(used))]
    )
    order = np.argsort(left)
    best, next_best = left[order[0]], left[order[1]]
    name = anchors.anchors[used[order[0]]]
    if best * CONTRADICTS < min(scatter(fit), next_best):
        raise DatasetError(
            f"anchor {name} contradicts the others: with it ranges scatter by {scatter(fit):.2f} m, without it by {best:.2f} m",
            valid="its true place in the anchors file (`uwb-mitigation survey` finds it)",
        )
