"""The HTML page of a site's calibration, with the figures of the viewer: map, residuals before and after, offsets."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from typing import Any

import numpy as np
from markupsafe import Markup

from uwb_mitigation.calibration.site import SiteCalibration
from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.viewer.histories import Pose
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.report import draw_boxes, draw_scene, render_report
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.state import View

PERCENTILES = (5, 25, 50, 75, 95)
SDS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])


def site_page(calibration: SiteCalibration, name: str, bundle: Bundle, files: tuple[str, str]) -> str:
    """Return one HTML page without external resources.

    Args:
        calibration: the result.
        name: names of the recordings.
        bundle: the model that was written.
        files: names of the files of the model and of the offsets.
    """
    solution, site = calibration.solution, calibration.site
    anchor_row = site.ranges.anchor[solution.rows]
    errors_m = np.stack([calibration.raw_error_m, calibration.held_out_error_m])
    is_known = np.isfinite(errors_m).all(axis=0)
    table: list[tuple[object, ...]] = [
        ("anchor", "ranges", "raw, mean |residual|, m", "calibrated, mean |residual|, m")
    ]
    boxes = dict[TrackKind, dict[str, Iterable[float]]]({TrackKind.RAW: {}, TrackKind.CORRECTED: {}})
    for row_number, anchor in enumerate(site.anchors.anchors):
        of_anchor = errors_m[:, (anchor_row == row_number) & is_known]
        if of_anchor.size:
            table.append(
                (anchor, of_anchor.shape[1], *(f"{mean:.3f}" for mean in np.abs(of_anchor).mean(axis=1)))
            )
            for row, residuals_m in zip(boxes.values(), of_anchor, strict=True):
                row[str(anchor)] = np.percentile(residuals_m, PERCENTILES)
    offsets = {
        f"tag {format_id(tag)}, anchor {format_id(anchor)}": values
        for (tag, anchor), values in calibration.pairs.items()
    }
    bars = {TrackKind.CORRECTED: {pair: offset_m + SDS * sd_m for pair, (offset_m, sd_m) in offsets.items()}}
    figures, _ = draw_scene(_view(calibration, errors_m[:, is_known]))
    reference = "the distance from the track that the other anchors give (not ground truth)"
    if solution.truth:
        reference = f"the range from {solution.truth}"
    lines = [
        calibration.summary(),
        *_details(calibration),
        f"Recordings: {name}. Model: {bundle.model_id:08x}, {files[0]}. Offsets: {files[1]}. "
        f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC.",
        Markup(
            "Next: <code>ros2 run uwb_mitigation mitigator --ros-args -p model:={} -p offsets:={}</code>"
        ).format(*files),
        f"Residuals: measured range minus {reference}. The model was fitted without the segment that it is tested on. Boxes: "
        "middle half of the ranges and median; lines: 5 to 95 %. Offsets: one and two standard deviations.",
        *calibration.notes,
    ]
    sections: dict[str, Any] = {
        "Where the tag was": figures["map"],
        "Residuals of each anchor": draw_boxes("residuals", "residual, m", boxes),
        "Mean residuals of each anchor": table,
        "Residuals before and after": figures["errors"],
        "Residuals before and after, cumulative": figures["distribution"],
        "Offsets of the radios": draw_boxes("offsets", "offset, m", bars),
        "Values of the offsets": [
            ("radios", "offset, m", "standard deviation, m"),
            *((pair, f"{offset_m:.3f}", f"{sd_m:.3f}") for pair, (offset_m, sd_m) in offsets.items()),
        ],
        # A richer model is chosen if it reduces the error by 2 %.
        "Models that were tried": [
            ("model", "mean absolute error on held-out segments and anchors, m"),
            *((model + " (chosen)" * (model == calibration.chosen), f"{mae_m:.3f}") for model, mae_m in calibration.mae_m.items()),
        ],
    }  # fmt: skip
    return render_report(f"Calibration from {name}", lines, sections)


def _details(calibration: SiteCalibration) -> Iterable[str]:
    solution = calibration.solution
    if solution.alignment is not None:
        arms = "; ".join(", ".join(f"{value:.3f}" for value in arm) for arm in solution.alignment.lever_arm_m)
        yield f"Localisation {solution.truth}: time offset {solution.alignment.time_offset_s:.3f} s, lever arm {arms} m."


def _view(calibration: SiteCalibration, errors_m: np.ndarray[Any, Any]) -> View:
    """Return anchors, tracks, stationary positions, and errors before and after, float64 (2, n), as the viewer draws them."""
    scene, solution = Scene(lambda: 0.0), calibration.solution
    scene.set_anchors(calibration.site.anchors.anchors)
    for segment in np.unique(solution.track_of):
        places = solution.track[(solution.track_of == segment) & np.isfinite(solution.track).all(axis=1)]
        poses = [Pose(x, y, z, received_s=0.0) for x, y, z in places.tolist()]
        scene.set_track(f"segment {segment}", TrackKind.CORRECTED, poses)
        if len(poses) == 1:
            # A stationary tag.
            scene.add_pose(f"segment {segment}", poses[0])
    scene.count_errors(errors_m)
    return View(scene)
