"""The HTML page of a site's calibration: the track, errors before and after, and the results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.evaluation.page import render_page
from uwb_mitigation.training.site_calibration import SiteCalibration

MAX_POINTS = 2000
WIDTH, HEIGHT, MARGIN = 720.0, 480.0, 36.0


def site_page(found: SiteCalibration, name: str) -> str:
    """Return one HTML page without external resources; `name`: name of the recordings.

    Raises:
        MissingDependencyError: jinja2 is not installed.
    """
    solution, data = found.solution, found.data
    assert data.anchors is not None
    by_anchor: list[tuple[str, int, float, float]] = []
    for anchor in found.site.anchors.anchors:
        own = data.anchors == anchor.id
        if own.any():
            before, after = (
                float(np.abs(error[own]).mean()) for error in (found.raw_error_m, found.held_out_error_m)
            )
            by_anchor.append((str(anchor), int(own.sum()), before, after))
    facts = []
    if solution.alignment is not None:
        arms = "; ".join(", ".join(f"{value:.3f}" for value in own) for own in solution.alignment.lever_arm_m)
        facts.append(
            f"Localisation {solution.truth}: time offset {solution.alignment.time_offset_s:.3f} s, lever arm {arms} m."
        )
    if found.selection.model.factor is not None and solution.network_sd:
        factor = f"{found.selection.model.factor:.2f} +- {solution.network_sd:.2f}"
        facts.append(f"Factor of the universal network's predictions: {factor}.")
    if solution.line[1]:
        slope, sd = (100.0 * value for value in solution.line)
        facts.append(f"Received power: {slope:.2f} +- {sd:.2f} cm of range per dB.")
    offsets = [(format_id(tag), format_id(anchor), *own) for (tag, anchor), own in solution.pairs.items()]
    return render_page(
        "site.html.j2",
        name=name,
        summary=found.summary(),
        facts=facts,
        notes=found.notes,
        by_anchor=by_anchor,
        worst=max([max(row[2:]) for row in by_anchor] + [1e-9]),
        offsets=offsets,
        candidates={"raw": found.raw_mae_m, **found.selection.mae()},
        chosen=found.selection.chosen,
        width=WIDTH,
        height=HEIGHT,
        plan=_plan(found),
    )


def _plan(found: SiteCalibration) -> dict[str, object]:
    """Return anchors, tracks and stationary positions in pixels, and the number of pixels per metre."""
    solution = found.solution
    tracks = [solution.track[solution.track_of == one][:, :2] for one in np.unique(solution.track_of)]
    anchors = found.site.anchors.position[:, :2]
    every = np.concatenate([anchors, *tracks])
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
    scale = float((room / np.maximum(high - low, 1.0)).min())

    def pixels(position: NDArray[np.float64]) -> list[list[float]]:
        flat = position[np.isfinite(position).all(axis=1)]
        away = (flat - low) * scale + MARGIN
        away[:, 1] = HEIGHT - away[:, 1]
        points: list[list[float]] = away[:: max(1, len(away) // MAX_POINTS)].round(1).tolist()
        return points

    shown = list(map(pixels, tracks))
    names = map(str, found.site.anchors.anchors)
    return {
        "scale": scale,
        "anchors": list(zip(names, pixels(anchors), strict=True)),
        "lines": [" ".join(f"{x},{y}" for x, y in points) for points in shown if len(points) != 1],
        "dots": [points[0] for points in shown if len(points) == 1],
    }
