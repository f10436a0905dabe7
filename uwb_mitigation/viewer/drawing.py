"""Draw a scene into the figures of one page."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import FAULTS, Status
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.headline import live_positions, recorded_positions
from uwb_mitigation.viewer.histories import HISTORY_S, MAX_RANGE_M, NO_DATA_S, History, RangeColumns
from uwb_mitigation.viewer.models import TRACE_AFTER, TRACE_BEFORE
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import (
    ERROR_EDGES_M,
    Pose,
    Scene,
    count_errors,
    finite_or_zero,
    plain_tag_id,
    tag_label,
    with_gaps,
)
from uwb_mitigation.viewer.state import PageState, drawable, no_data, set_rows

MAX_LABEL = 20
"""Maximum number of characters of a name on the map."""

MARGIN_M = 5.0
"""Margin around a tag on a map without anchors."""

MAX_POINTS = 1200
"""Maximum number of displayed points of a line."""

RANGE_SD_M = 0.1
"""Standard deviation for the map of the predicted accuracy if the ranges have none."""


class Figures:
    """Draws the map and the other figures of a page."""

    def __init__(self, state: PageState) -> None:
        self._state, self._models, self._view = state, state.models, state.view
        self._player = state.view.player
        self._fitted = False, False, False

    def draw(self, scene: Scene) -> None:
        """Draw what has changed."""
        self.draw_map(scene)
        history = None if self._state.selected is None else scene.pairs.get(self._state.selected)
        self._draw_strip(scene, history)
        self._draw_trace(scene, history)
        self._draw_errors(scene)
        self._draw_history(scene, history)
        self._draw_positions(scene)

    def draw_map(self, scene: Scene) -> None:
        models, timeline = self._models, self._view.timeline
        anchors = []
        for identity, anchor in scene.anchors.items():
            state, residual_m = self._state.health.get(identity, (health.UNKNOWN, math.nan))
            name = anchor.name or format_id(identity)
            label = name[:MAX_LABEL] + (f" {state[0]}" if state != health.UNKNOWN else "")
            if timeline is not None and identity in timeline.displaced:
                label += " not here"
            elif state in (health.BAD, health.CHECK) and abs(residual_m) >= health.LONG_M:
                # Rounded, so that the map is not drawn again for every range.
                label += f" {residual_m:+.1f} m"
            values = *anchor.position[:2], name, str(identity), state, label
            anchors.append(dict(zip(models.anchors.data, values, strict=True)))
        if self._state.changed("anchors", anchors):
            set_rows(models.anchors, anchors)
        place = scene.anchors.get(self._state.selected[0]) if self._state.selected else None
        if self._state.changed("selected", place):
            set_rows(models.selected, [dict(zip("xy", place.position, strict=False))] if place else [])
        tags: list[dict[str, Any]] = []
        plain_id = plain_tag_id(scene.tags, scene.pairs)
        for name, tag in scene.tags.items():
            if (pose := tag.pose) is not None:
                age_s, label = scene.age_s(tag), tag_label(name, plain_id)
                major, minor, angle = map(drawable, pose.ellipse)
                is_late = age_s > NO_DATA_S
                tags.append({
                    "x": pose.x, "y": pose.y, "label_y": pose.y + finite_or_zero(_half_height(pose)),
                    "name": f"{label}: no data for {age_s:.0f} s" if is_late else label, "status": "no data" if is_late else "OK",
                    "width": 2 * major, "height": 2 * minor, "angle": angle, "heading": pose.heading_rad,
                })  # fmt: skip
        set_rows(models.tags, tags)
        self._draw_tracks(scene)
        self._draw_accuracy(scene)
        fitted = scene.is_indexed, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        # The view is set for the first content and for the first anchors, and then only by the user.
        if fitted > self._fitted or not models.extent.data["x"]:
            self._fitted = fitted
            self.fit(scene)
        self._draw_rays(scene)
        models.update_legend()

    def _draw_tracks(self, scene: Scene) -> None:
        for kind, source in self._models.tracks.items():
            tracks = [
                view
                for (_, track_kind), view in scene.tracks.items()
                if track_kind is kind and len(view.points)
            ]
            state = [(len(view.points), view.points[-1][0], math.floor(scene.age_s(view))) for view in tracks]
            if self._state.changed(kind.value, state):
                # A NaN separates the tracks of two tags.
                points = [np.zeros((0, 2))]
                for view in tracks:
                    points += [self._trail(view.columns(), scene.age_s(view)), np.full((1, 2), np.nan)]
                x, y = np.concatenate(points).astype(np.float32).T
                source.data = {"x": x, "y": y}

    def _trail(self, track: NDArray[np.float64], age_s: float) -> NDArray[np.float64]:
        """Return x and y of the displayed time of a track whose last point has an age, float64 (k, 2)."""
        begin = np.searchsorted(track[:, 0], track[-1, 0] + age_s - self._state.trail_s)
        return _line(track[begin:, :3], NO_DATA_S)[:, 1:]

    def _draw_accuracy(self, scene: Scene) -> None:
        """Draw the map of the predicted accuracy if it is visible."""
        models, tag = self._models, next(iter(scene.tags.values()), None)
        if not models.coverage[0].visible or len(scene.anchors) < 2:
            return
        anchors = np.nan_to_num([anchor.position for anchor in scene.anchors.values()])
        height_m = finite_or_zero(tag.pose.z if tag and tag.pose else math.nan)
        sds_m = [sample.sigma_m for _, _, sample in scene.latest() if sample.sigma_m > 0.0]
        sd_m = round(float(np.median(sds_m)), 2) if sds_m else RANGE_SD_M
        if self._state.changed("accuracy", (anchors.tobytes(), round(height_m, 1), sd_m)):
            image, low, size = health.predicted_accuracy(anchors, height_m, sd_m)
            steps = np.searchsorted(health.STEPS_M, image).astype(np.float32)
            steps[~(image <= health.STEPS_M[-1])] = np.nan
            models.accuracy.data = {
                "image": [steps], "x": [low[0]], "y": [low[1]], "dw": [size[0]], "dh": [size[1]]
            }  # fmt: skip

    def fit(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [anchor.position[:2] for anchor in scene.anchors.values()]
        places += [(tag.pose.x, tag.pose.y) for tag in scene.tags.values() if tag.pose is not None]
        timeline, live = self._view.complete, (view.columns() for view in scene.tracks.values())
        for track in live if timeline is None else timeline.tracks.values():
            places += np.percentile(track[:, 1:3], (2, 98), axis=0).tolist() if len(track) else []
        corners = np.array(places or [(0.0, 0.0), (10.0, 10.0)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # A margin for ellipses and labels; without anchors, one in which the tag can move.
        margin = 0.1 * float((high - low).max()) if scene.anchors or not places else MARGIN_M
        low, high = low - margin, high + margin
        self._models.extent.data = {name: [float(low[i]), float(high[i])] for i, name in enumerate("xy")}

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays with statuses from the anchors to the tag of the selected pair."""
        rows = []
        tag_id = self._state.tag_id
        tag = None if tag_id is None else scene.tag_of(tag_id)
        for (anchor_id, of_tag), history, sample in scene.latest():
            place = scene.anchors.get(anchor_id)
            if of_tag == tag_id and tag and tag.pose and place and not no_data(scene, history):
                (x0, y0, _), x1, y1 = place.position, tag.pose.x, tag.pose.y
                ends = {"x0": x0, "y0": y0, "x1": x1, "y1": y1}
                middle = {"x": (x0 + x1) / 2, "y": (y0 + y1) / 2}
                rows.append(ends | middle | {"status": sample.status.name})
        set_rows(self._models.rays, rows)

    def _ranges(self, scene: Scene, begin_s: float = -math.inf, end_s: float = math.inf) -> RangeColumns:
        """Return the ranges of the selected pair: in an interval of an indexed recording, else those of the scene."""
        pair, timeline = self._state.selected or (-1, -1), self._view.timeline
        if timeline is not None:
            return timeline.ranges(pair, begin_s, end_s)
        return (scene.pairs.get(pair) or History()).columns()

    def _draw_strip(self, scene: Scene, history: History | None) -> None:
        # Also draw a pair without new data, because its ranges age.
        now_s = scene.now_s(self._state.tag_id)
        timeline, player = self._view.timeline, self._player
        if not self._state.changed("strip", (self._state.selected, now_s, scene.ranges, timeline is None)):
            return
        if timeline is not None and player is not None:
            now_s = player.shown_s
        ranges = self._ranges(scene, now_s - HISTORY_S, now_s)
        columns = ranges.time_s - now_s, ranges.raw_m, ranges.corrected_m, ranges.true_m, ranges.status
        table = np.column_stack(columns)[ranges.time_s >= now_s - HISTORY_S]
        table[:, 1:][~(np.abs(table[:, 1:]) < MAX_RANGE_M)] = np.nan
        none = "No range of this pair yet."
        if history is not None and history.samples:
            none = f"No range of this pair in the last {HISTORY_S:.0f} s."
        bad = table[np.isin(table[:, 4], FAULTS)]
        if len(bad) or len(self._models.bad.data["age"]):
            statuses = [Status(int(status)).name for status in bad[:, 4]]
            self._models.bad.data = {"age": bad[:, 0], "corrected": bad[:, 2], "status": statuses}
        message = "" if np.isfinite(table[:, 1]).any() else none
        self._models.fill("strip", self._models.strip, _line(table[:, :4], _gap_s(history)), message)

    def _draw_trace(self, scene: Scene, history: History | None) -> None:
        models, trace, message = self._models, None, ""
        if history is not None and history.traces:
            trace = history.traces[-1]
        elif any(other.traces for other in scene.pairs.values()):
            message = "No CIR of this pair yet."
        else:
            message = "No CIRs: the source sends none, or no raw ranges are received."
        models.show_empty("cir", message)
        # Compare the trace instead of its stamp, because stamps may be equal.
        if not self._state.changed("trace", (self._state.selected, trace)):
            return
        if trace is None:
            set_rows(models.trace, [])
            set_rows(models.marks, [])
            return
        cir, magnitude = trace.cir, trace.magnitude
        sample = np.arange(len(magnitude)) + (cir.start_index - trace.origin)
        shown = (sample >= -TRACE_BEFORE) & (sample < TRACE_AFTER)
        models.trace.data = {"sample": sample[shown].astype(np.float32), "magnitude": magnitude[shown]}
        levels = {"noise": cir.noise_threshold, "first": finite_or_zero(cir.first_path_index - trace.origin)}
        set_rows(models.marks, [levels | {"from": -WINDOW_LEAD, "to": self._view.window - WINDOW_LEAD}])

    def _draw_errors(self, scene: Scene) -> None:
        timeline = self._view.timeline
        if not self._state.changed("errors", scene.errors if timeline is None else -1):
            return
        counts = scene.error_counts if timeline is None else count_errors(timeline.range_errors)
        shares = 100.0 * np.cumsum(counts, axis=1) / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        table = np.stack([ERROR_EDGES_M[:-1], ERROR_EDGES_M[1:], *counts, *shares], axis=1)
        self._models.fill("errors", self._models.errors, table, "" if counts.any() else "No true ranges.")

    def _draw_history(self, scene: Scene, history: History | None) -> None:
        """Draw residual, rate and NLOS share of the selected pair: in the recording, or in the last minute."""
        now_s = finite_or_zero(scene.now_s(self._state.tag_id)) if self._player is None else 0.0
        # All of it moves every second.
        state = self._state.selected, math.floor(now_s), self._view.complete is None
        if not self._state.changed("history", state):
            return
        table = self._ranges(scene).quality() - (now_s, 0.0, 0.0, 0.0)
        message = "" if np.isfinite(table[:, 1]).any() else "No residuals of this pair yet."
        self._models.fill("history", self._models.history, _line(table, _gap_s(history)), message)

    def _draw_positions(self, scene: Scene) -> None:
        """Draw the errors of the positions of the selected tag with and without correction, with two standard deviations."""
        timeline, models, tag_id = self._view.complete, self._models, self._state.tag_id
        live_s = math.floor(scene.clock()) if self._player is None else -1
        if not self._state.changed("positions", (tag_id, timeline is None, live_s)):
            return
        positions = live_positions(scene, tag_id) if self._player is None else None
        if timeline is not None:
            positions = recorded_positions(timeline, tag_id)
        kinds = TrackKind.CORRECTED, TrackKind.RAW
        none = np.zeros((0, 3))
        table, raw = (none if positions is None else positions.error_columns(kind) for kind in kinds)
        now_s = table[-1, 0] if self._player is None and len(table) else 0.0
        message = "" if np.isfinite(table[:, 1:]).any() else "No positions."
        models.fill("positions", models.positions, _line(table - (now_s, 0.0, 0.0), NO_DATA_S), message)
        models.fill("positions", models.raw_positions, _line(raw[:, :2] - (now_s, 0.0), NO_DATA_S), message)


def _gap_s(history: History | None) -> float:
    """Return the duration without ranges of a pair that interrupts its lines."""
    return NO_DATA_S if history is None else history.max_gap_s


def _line(table: NDArray[np.float64], gap_s: float) -> NDArray[np.float64]:
    """Return rows of a line whose first column is the time: about `MAX_POINTS`, at equal steps, interrupted by gaps."""
    return with_gaps(table[:: -max(1, -(-len(table) // MAX_POINTS))][::-1], gap_s)


def _half_height(pose: Pose) -> float:
    """Return the extent of the ellipse of a pose in y, m."""
    major, minor, angle = pose.ellipse
    return math.hypot(drawable(major) * math.sin(angle), drawable(minor) * math.cos(angle))
