"""What geometry cannot tell: refused in words, with what is missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Shape, shape
from uwb_mitigation.positioning.joint import JointFit, JointSolver, Links
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.other_anchors import less_parameters
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Area, Height

MOVES_M = 1.0
LEAST_NEW = 20
"""Ranges that say something new, beside those that a place at rest takes."""

MIRRORED = 4.5
"""Mirror images are as good where one is not less likely than the other by e^-4.5."""


def check_anchors(
    anchors: AnchorMap, used: NDArray[np.intp], height: Height | None, area: Area | None = None
) -> None:
    """Refuse anchors that cannot tell.

    Args:
        used: rows of those that were heard.
        area: where tags can be; it can exclude the mirror image of a track at a plane of anchors.

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
    if height is None and area is None and kind is Shape.PLANE:
        raise DatasetError(
            "the anchors are all in a plane: mirrored at it, the track explains the ranges as well",
            valid="--height of the tag, --area on one side of the plane, or an anchor above or below that plane",
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
