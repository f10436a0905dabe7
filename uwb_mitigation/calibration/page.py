"""The HTML page of a site's calibration: the track, errors before and after, and the results."""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.html import render_page
from uwb_mitigation.calibration.site import SiteCalibration
from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.model.bundle import Bundle

MAX_POINTS = 2000
WIDTH, HEIGHT, MARGIN = 380.0, 280.0, 24.0
"""Size of the plan, pixels: readable on a phone."""
ROW, LEFT = 58.0, 12.0
"""Height of an anchor in the figure of the residuals, and its left margin, pixels."""
PERCENTILES = (5, 25, 50, 75, 95)


def site_page(calibration: SiteCalibration, name: str, bundle: Bundle, files: tuple[str, str]) -> str:
    """Return one HTML page without external resources.

    Args:
        calibration: the result.
        name: names of the recordings.
        bundle: the model that was written.
        files: names of the files of the model and of the offsets.

    Raises:
        MissingDependencyError: jinja2 is not installed.
    """
    solution, data = calibration.solution, calibration.data
    assert data.anchors is not None
    by_anchor: list[tuple[str, int, float, float]] = []
    boxes: list[tuple[str, list[list[float]]]] = []
    for anchor in calibration.site.anchors.anchors:
        anchor_rows = (data.anchors == anchor.id) & np.isfinite(calibration.held_out_error_m)
        if anchor_rows.any():
            errors = [error[anchor_rows] for error in (calibration.raw_error_m, calibration.held_out_error_m)]
            before, after = (float(np.abs(error).mean()) for error in errors)
            by_anchor.append((str(anchor), int(anchor_rows.sum()), before, after))
            boxes.append((str(anchor), [np.percentile(error, PERCENTILES).tolist() for error in errors]))
    details = []
    if solution.alignment is not None:
        arms = "; ".join(", ".join(f"{value:.3f}" for value in arm) for arm in solution.alignment.lever_arm_m)
        details.append(
            f"Localisation {solution.truth}: time offset {solution.alignment.time_offset_s:.3f} s, lever arm {arms} m."
        )
    if calibration.model.has_network and solution.network_sd:
        factor = f"{calibration.model.factor:.2f} +- {solution.network_sd:.2f}"
        details.append(f"Factor of the universal network's predictions: {factor}.")
    offsets = [
        (format_id(tag), format_id(anchor), *values) for (tag, anchor), values in calibration.pairs.items()
    ]
    return render_page(
        "site.html.j2",
        name=name,
        summary=calibration.summary(),
        details=details,
        notes=calibration.notes,
        reference=solution.truth,
        by_anchor=by_anchor,
        residuals=_residuals(boxes),
        date=f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        model_id=f"{bundle.model_id:08x}",
        files=files,
        colours={"raw": "#d55e00", "calibrated": "#0072b2"},
        offsets=offsets,
        candidates=calibration.mae_m,
        chosen=calibration.chosen,
        width=WIDTH,
        height=HEIGHT,
        plan=_plan(calibration),
    )


def _residuals(boxes: list[tuple[str, list[list[float]]]]) -> dict[str, object]:
    """Return the figure of the residuals in pixels: for each anchor the percentiles before and after."""
    values = np.array([box for _, pair in boxes for box in pair] or [[0.0, 1.0]])
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    step = next(step for step in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 1e9) if high - low <= 6 * step)
    scale = (WIDTH - 2 * LEFT) / max(high - low, 1e-9)

    def pixel(value: float) -> float:
        return round(LEFT + (value - low) * scale, 1)

    ticks = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    return {
        "height": ROW * len(boxes) + 30.0,
        "row": ROW,
        "ticks": [(pixel(tick), f"{tick:g}") for tick in ticks.round(1).tolist()],
        "boxes": [(anchor, [[pixel(value) for value in box] for box in pair]) for anchor, pair in boxes],
    }


def _plan(calibration: SiteCalibration) -> dict[str, object]:
    """Return anchors, tracks and stationary positions in pixels, and the number of pixels per metre."""
    solution = calibration.solution
    tracks = [solution.track[solution.track_of == number][:, :2] for number in np.unique(solution.track_of)]
    anchors = calibration.site.anchors.position[:, :2]
    all_points = np.concatenate([anchors, *tracks])
    all_points = all_points[np.isfinite(all_points).all(axis=1)]
    low, high = all_points.min(axis=0), all_points.max(axis=0)
    available_px = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
    scale = float((available_px / np.maximum(high - low, 1.0)).min())

    def pixels(position: NDArray[np.float64]) -> list[list[float]]:
        finite = position[np.isfinite(position).all(axis=1)]
        pixel = (finite - low) * scale + MARGIN
        pixel[:, 1] = HEIGHT - pixel[:, 1]
        points: list[list[float]] = pixel[:: max(1, len(pixel) // MAX_POINTS)].round(1).tolist()
        return points

    shown = list(map(pixels, tracks))
    names = map(str, calibration.site.anchors.anchors)
    return {
        "scale": scale,
        "anchors": list(zip(names, pixels(anchors), strict=True)),
        "lines": [" ".join(f"{x},{y}" for x, y in points) for points in shown if len(points) != 1],
        "dots": [points[0] for points in shown if len(points) == 1],
    }
