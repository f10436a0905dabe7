"""The report of a site's calibration: the track, errors before and after, and the results."""

from __future__ import annotations

from datetime import datetime, timezone
from threading import Lock
from typing import Any

import numpy as np

from uwb_mitigation.calibration.site import SiteCalibration
from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.models import interval_figure
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.report import draw_scene, render_report
from uwb_mitigation.viewer.scene import Pose, Scene
from uwb_mitigation.viewer.state import View

PERCENTILES = (5, 25, 50, 75, 95)
STEP_S = 0.1
"""Interval of the displayed track, whose own times are not known."""


def site_page(calibration: SiteCalibration, name: str, bundle: Bundle, files: tuple[str, str]) -> str:
    """Return one HTML page without external resources.

    Args:
        calibration: the result.
        name: names of the recordings.
        bundle: the model that was written.
        files: names of the files of the model and of the offsets.
    """
    solution, data = calibration.solution, calibration.data
    assert data.anchors is not None
    rows: list[tuple[object, ...]] = [
        ("anchor", "ranges", "raw, mean |residual|, m", "calibrated, mean |residual|, m")
    ]
    boxes: dict[Any, list[float]] = {}
    for anchor in calibration.site.anchors.anchors:
        anchor_rows = (data.anchors == anchor.id) & np.isfinite(calibration.held_out_error_m)
        if anchor_rows.any():
            errors = [error[anchor_rows] for error in (calibration.raw_error_m, calibration.held_out_error_m)]
            rows.append((anchor, anchor_rows.sum(), *(f"{np.abs(error).mean():.3f}" for error in errors)))
            for kind, error in zip(("raw", "calibrated"), errors, strict=True):
                boxes[f"anchor {anchor}", kind] = np.percentile(error, PERCENTILES).tolist()
    lines = [calibration.summary()]
    if solution.alignment is not None:
        arms = "; ".join(", ".join(f"{value:.3f}" for value in arm) for arm in solution.alignment.lever_arm_m)
        lines.append(
            f"Localisation {solution.truth}: time offset {solution.alignment.time_offset_s:.3f} s, lever arm {arms} m."
        )
    if calibration.model.has_network and solution.network_sd:
        factor = f"{calibration.model.factor:.2f} +- {solution.network_sd:.2f}"
        lines.append(f"Factor of the universal network's predictions: {factor}.")
    lines += [
        f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC; model {bundle.model_id:08x}, {files[0]}; offsets: {files[1]}.",
        f"Next: ros2 run uwb_mitigation mitigator --ros-args -p model:={files[0]} -p offsets:={files[1]}",
        *calibration.notes,
        "Residual: measured range minus "
        + (f"the range from {solution.truth}" if solution.truth
           else "the distance from the track that the other anchors give (not ground truth)")
        + ". The model was fitted without the segment that it is tested on. Boxes: middle half of the ranges, and median; lines: "
        "5 to 95 %. Offsets: one and two standard deviations.",
    ]  # fmt: skip
    offsets = {
        f"tag {format_id(tag)}, anchor {format_id(anchor)}": pair
        for (tag, anchor), pair in calibration.pairs.items()
    }
    bars = {
        pair: [offset + step * sd for step in (-2, -1, 0, 1, 2)] for pair, (offset, sd) in offsets.items()
    }
    tried = [
        (model + " (chosen)" * (model == calibration.chosen), f"{mae:.3f}")
        for model, mae in calibration.mae_m.items()
    ]
    parts: dict[str, Any] = {
        "Residuals of each anchor": interval_figure("residuals", "residual, m", boxes),
        "Mean residuals": rows,
        "Where the tag was": _map(calibration),
        "Models that were tried: MAE on held-out segments and anchors": [("model", "m"), *tried],
        "Offsets of the radios": interval_figure("offsets", "offset, m", bars),
        "Values of the offsets": [
            ("pair", "offset, m", "standard deviation, m"),
            *((pair, f"{offset:.3f}", f"{sd:.3f}") for pair, (offset, sd) in offsets.items()),
        ],
    }
    return render_report(f"Calibration from {name}", lines, parts)


def _map(calibration: SiteCalibration) -> Any:
    """Return the map of the viewer with anchors, tracks and stationary positions."""
    scene, solution = Scene(lambda: 0.0), calibration.solution
    feed = SceneUpdater(scene, Lock())
    feed.anchors(calibration.site.anchors)
    for number in np.unique(solution.track_of).tolist():
        points = solution.track[solution.track_of == number]
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) == 1:
            x, y, z = points[0].tolist()
            scene.add_pose(f"position {number + 1}", Pose(x, y, z, stamp_s=0.0))
        else:
            columns = np.column_stack([np.arange(len(points)) * STEP_S, points, np.full(len(points), np.nan)])
            scene.set_track(f"track {number + 1}", TrackKind.CORRECTED, columns)
    return draw_scene(View(scene, feed.lock)).figures["map"]
