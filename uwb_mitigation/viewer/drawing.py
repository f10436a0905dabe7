"""Draw a scene into the figures of one page."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import FAULTS, LINE_OF_SIGHT_DB, Status
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.headline import WHOLE, Positions, live_positions, recorded_positions
from uwb_mitigation.viewer.histories import (
    HISTORY_S,
    MAX_RANGE_M,
    NO_DATA_S,
    RATE_RANGES,
    WATERFALL,
    History,
    RangeColumns,
    Sample,
    Trace,
)
from uwb_mitigation.viewer.models import FADING, TRACE_AFTER, TRACE_BEFORE
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import (
    CELL_M,
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

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer

MAX_LABEL = 20
"""Maximum number of characters of a name on the map."""

MARGIN_M = 5.0
"""Margin around a tag on a map without anchors."""

MAX_POINTS = 400
"""Maximum number of displayed points of each third of a track, and of a strip."""

MIN_HEAT_M = 0.1
"""Minimum extent of the colours of the mean correction, so that the labels of the colour bar differ."""

RANGE_SD_M = 0.1
"""Standard deviation for the map of the predicted accuracy if the ranges have none."""

_NO_CIRS = "No CIRs: the source sends none, or no raw ranges are received."


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
        self._draw_trace(scene, () if history is None else tuple(history.traces))
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
                    "protection": drawable(pose.protection_m),
                })  # fmt: skip
        set_rows(models.tags, tags)
        self._draw_tracks(scene)
        self._draw_accuracy(scene, [sample for _, _, sample in scene.latest()])
        fitted = scene.is_indexed, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        # The view is set for the first content and for the first anchors, and then only by the user.
        if fitted > self._fitted or not models.extent.data["x"]:
            self._fitted = fitted
            self.fit(scene)
        self._draw_rays(scene)
        models.update_legend()

    def _draw_tracks(self, scene: Scene) -> None:
        models, second = self._models, self._view.second
        for kind, sources in models.tracks.items():
            origin, origin_kind = scene, kind
            if kind is TrackKind.SECOND and second is not None:
                origin, origin_kind = second.scene, TrackKind.CORRECTED
            tracks = [
                view for (_, track_kind), view in origin.tracks.items() if track_kind is origin_kind and len(view.points)
            ]  # fmt: skip
            state = [(len(view.points), view.points[-1][0], math.floor(scene.age_s(view))) for view in tracks]
            if not self._state.changed(kind.value, (self._state.trail_s, state)):
                continue
            thirds = [self._fading(view.columns(), scene.age_s(view)) for view in tracks]
            for third, source in enumerate(sources):
                # A NaN separates the tracks of two tags.
                rows = [row for points in thirds for row in (points[third], [(math.nan, math.nan)])]
                columns = np.concatenate(rows).astype(np.float32) if rows else np.zeros((0, 2), np.float32)
                source.data = {"x": columns[:, 0], "y": columns[:, 1]}
        shown = models.layers["heat"][0].visible
        if shown and self._state.changed("heat", sum(entry[1] for entry in scene.heat.values())):
            cells = np.array([(*cell, entry[0] / entry[1]) for cell, entry in scene.heat.items()], np.float32)
            x, y, mean = cells.reshape(-1, 3).T
            models.heat.data = {"x": (x + 0.5) * CELL_M, "y": (y + 0.5) * CELL_M, "mean": mean}
            if len(mean):
                low, high = np.percentile(mean, (5, 95)).tolist()
                models.heat_levels.update(low=low, high=max(high, low + MIN_HEAT_M))

    def _fading(self, track: NDArray[np.float64], age_s: float) -> list[NDArray[np.float64]]:
        """Return x and y of the newest, middle and oldest third of the displayed time of a track, float64 (k, 2)."""
        time_s, now_s = track[:, 0], track[-1, 0] + age_s
        edges_s = now_s - min(self._state.trail_s, now_s - time_s[0]) / len(FADING) * np.arange(
            len(FADING) + 1
        )
        ends = np.searchsorted(time_s, edges_s, side="right")
        ends[-1] = np.searchsorted(time_s, edges_s[-1])
        # The first point of the next third belongs to both, so that the line is continuous.
        return [
            with_gaps(_thin(track[begin : end + 1, :3]), NO_DATA_S)[:, 1:]
            for end, begin in pairwise(ends.tolist())
        ]

    def _draw_accuracy(self, scene: Scene, shown: list[Sample]) -> None:
        """Draw the map of the predicted accuracy if it is visible."""
        models, tag = self._models, next(iter(scene.tags.values()), None)
        if not models.layers["accuracy"][0].visible or len(scene.anchors) < 2:
            return
        anchors = np.nan_to_num([anchor.position for anchor in scene.anchors.values()])
        height_m = finite_or_zero(tag.pose.z if tag and tag.pose else math.nan)
        sds_m = [sample.sigma_m for sample in shown if sample.sigma_m > 0.0]
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
        timeline = None if self._player is None else self._player.timeline
        tracks = [view.columns() for view in scene.tracks.values()]
        if timeline is not None and timeline.is_complete:
            tracks = list(timeline.tracks.values())
        for track in tracks:
            places += np.percentile(track[:, 1:3], (2, 98), axis=0).tolist() if len(track) else []
        corners = np.array(places or [(0.0, 0.0), (10.0, 10.0)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # A margin for ellipses and labels; without anchors, one in which the tag can move.
        margin = 0.1 * float((high - low).max()) if scene.anchors or not places else MARGIN_M
        low, high = low - margin, high + margin
        self._models.extent.data = {name: [float(low[i]), float(high[i])] for i, name in enumerate("xy")}

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays, circles and statuses of the tag of the selected pair."""
        rows, symbols = [], []
        tag = None if self._state.selected is None else scene.tag_of(self._state.selected[1])
        pose = None if tag is None else tag.pose
        for pair, history, sample in scene.latest():
            place = scene.anchors.get(pair[0])
            is_drawable = math.isfinite(drawable(sample.range_m)) and not no_data(scene, history)
            if (
                self._state.selected is None
                or pair[1] != self._state.selected[1]
                or place is None
                or not is_drawable
            ):
                continue
            x, y, z = place.position
            height_m = 0.0 if pose is None else finite_or_zero(pose.z - z)
            raw_m, corrected_m = (
                math.sqrt(max(finite_or_zero(drawable(value)) ** 2 - height_m * height_m, 0.0))
                for value in (sample.raw_m, sample.range_m)
            )
            x1, y1 = (x, y) if pose is None else (pose.x, pose.y)
            ends = {"x": x, "y": y, "x1": x1, "y1": y1}
            rows.append(ends | {"raw": raw_m, "corrected": corrected_m, "status": sample.status.name})
            if pose is not None:
                middle = {"x": (x + x1) / 2, "y": (y + y1) / 2}
                symbols.append(middle | {"status": sample.status.name})
        set_rows(self._models.rays, rows)
        set_rows(self._models.statuses, symbols)

    def _ranges(
        self, player: BagPlayer | None, scene: Scene, begin_s: float = -math.inf, end_s: float = math.inf
    ) -> RangeColumns:
        """Return the ranges of the selected pair: in an interval of an indexed recording, else those of the scene."""
        pair = self._state.selected or (-1, -1)
        if player is not None and player.timeline is not None:
            return player.timeline.ranges(pair, begin_s, end_s)
        return (scene.pairs.get(pair) or History()).columns()

    def _draw_strip(self, scene: Scene, history: History | None) -> None:
        # Also draw a pair without new data, because its ranges age.
        now_s = scene.now_s(self._state.tag_id)
        timeline, player, second = self._view.timeline, self._player, self._view.second
        if not self._state.changed("strip", (self._state.selected, now_s, scene.ranges, timeline is None)):
            return
        if timeline is not None and player is not None:
            now_s = player.shown_s
        ranges = self._ranges(player, scene, now_s - HISTORY_S, now_s)
        second_m_at = dict[float, float]()
        if second is not None:
            compared = self._ranges(second, second.scene)
            second_m_at = dict(
                zip(compared.stamp_s.round(6).tolist(), compared.corrected_m.tolist(), strict=True)
            )
        compared_m = [second_m_at.get(stamp_s, math.nan) for stamp_s in ranges.stamp_s.round(6).tolist()]
        columns = (
            ranges.time_s - now_s,
            ranges.raw_m,
            ranges.corrected_m,
            ranges.true_m,
            compared_m,
            ranges.status,
        )
        table = np.column_stack(columns)[ranges.time_s >= now_s - HISTORY_S]
        table[:, 1:][~(np.abs(table[:, 1:]) < MAX_RANGE_M)] = np.nan
        none = "No range of this pair yet."
        if history is not None and history.samples:
            none = f"No range of this pair in the last {HISTORY_S:.0f} s."
        self._models.show_empty("strip", "" if np.isfinite(table[:, 1]).any() else none)
        bad = table[np.isin(table[:, 5], FAULTS)]
        if len(bad) or len(self._models.bad.data["age"]):
            statuses = [Status(int(status)).name for status in bad[:, 5]]
            self._models.bad.data = {"age": bad[:, 0], "corrected": bad[:, 2], "status": statuses}
        shown = with_gaps(_thin(table, 3 * MAX_POINTS), NO_DATA_S if history is None else history.max_gap_s)
        names = "age", "raw", "corrected", "true", "second"
        self._models.strip.data = dict(zip(names, shown[:, :5].T.astype(np.float32), strict=True))

    def _draw_trace(self, scene: Scene, traces: tuple[Trace, ...]) -> None:
        models = self._models
        if not traces:
            has_cirs = any(history.traces for history in scene.pairs.values())
            none = "No CIR of this pair yet." if has_cirs else _NO_CIRS
        models.show_empty("cir", "" if traces else none)
        # Compare the newest trace instead of its stamp, because stamps may be equal.
        if not self._state.changed("traces", (self._state.selected, traces[-1] if traces else None)):
            return
        models.waterfall.data = {"image": [_waterfall_image(traces)] if traces else []}
        if not traces:
            set_rows(models.trace, [])
            set_rows(models.marks, [])
            return
        trace = traces[-1]
        cir, magnitude = trace.cir, trace.magnitude
        sample = np.arange(len(magnitude)) + (cir.start_index - trace.origin)
        shown = (sample >= -TRACE_BEFORE) & (sample < TRACE_AFTER)
        models.trace.data = {"sample": sample[shown].astype(np.float32), "magnitude": magnitude[shown]}
        marks = {
            "noise": float(cir.noise_threshold),
            "first": finite_or_zero(cir.first_path_index - trace.origin),
            "from": -float(WINDOW_LEAD),
            "to": float(self._view.window - WINDOW_LEAD),
        }
        set_rows(models.marks, [marks])

    def _draw_errors(self, scene: Scene) -> None:
        player, timeline = self._player, self._view.timeline
        second = None if self._view.second is None else self._view.second.timeline
        end_s = math.inf if player is None or self._state.window == WHOLE else player.position_s
        live_errors = scene.errors if timeline is None else -1
        if not self._state.changed("errors", (live_errors, end_s, second is None)):
            return
        begin_s = end_s - HISTORY_S if end_s < math.inf else -math.inf
        counts = (
            scene.error_counts if timeline is None else count_errors(timeline.range_errors(begin_s, end_s))
        )
        compared = counts if second is None else count_errors(second.range_errors(begin_s, end_s))
        columns = zip(("raw", "corrected", "second"), (*counts.astype(float), compared[1]), strict=True)
        self._models.show_empty("errors", "" if counts.any() else "No true ranges.")
        data = dict(columns) | {"left": ERROR_EDGES_M[:-1], "right": ERROR_EDGES_M[1:]}
        for kind in ("raw", "corrected", "second"):
            data[f"{kind}_share"] = 100.0 * np.cumsum(data[kind]) / max(data[kind].sum(), 1.0)
        self._models.errors.data = data

    def _draw_history(self, scene: Scene, history: History | None) -> None:
        """Draw residual, rate and NLOS share of the selected pair: in the recording, or in the last minute."""
        is_recorded = self._player is not None
        is_complete = self._view.timeline is not None and self._view.timeline.is_complete
        now_s = 0.0 if is_recorded else finite_or_zero(scene.now_s(self._state.tag_id))
        # All of it moves every second.
        if not self._state.changed("history", (self._state.selected, math.floor(now_s), is_complete)):
            return
        ranges = self._ranges(self._player, scene)
        residual_m = np.where(np.abs(ranges.residual_m) < MAX_RANGE_M, ranges.residual_m, np.nan)
        is_nlos = np.where(np.isfinite(ranges.gap_db), ranges.gap_db >= LINE_OF_SIGHT_DB, np.nan)
        rate_hz, nlos = 1.0 / _rolling_mean(ranges.interval_s), 100.0 * _rolling_mean(is_nlos)
        table = np.column_stack([ranges.time_s - now_s, residual_m, rate_hz, nlos])
        message = "" if np.isfinite(residual_m).any() else "No residuals of this pair yet."
        table = with_gaps(_thin(table, 3 * MAX_POINTS), NO_DATA_S if history is None else history.max_gap_s)
        self._models.fill("history", self._models.history, table, message)

    def _positions(self, player: BagPlayer | None, scene: Scene) -> Positions | None:
        """Return the positions of the selected tag; None: the tracks of the recording are not known yet."""
        if player is None:
            return live_positions(scene, self._state.tag_id)
        timeline = player.timeline
        is_complete = timeline is not None and timeline.is_complete
        return recorded_positions(timeline, self._state.tag_id) if timeline and is_complete else None

    def _draw_positions(self, scene: Scene) -> None:
        """Draw the errors of the positions of the selected tag with and without correction, with two standard deviations."""
        second_player, models = self._view.second, self._models
        own = self._positions(self._player, scene)
        second = None if second_player is None else self._positions(second_player, second_player.scene)
        second_s = math.floor(scene.clock()) if self._player is None else -1
        state = self._state.tag_id, own is None, second is None, second_s
        if not self._state.changed("positions", state):
            return
        table = _error_columns(own, TrackKind.CORRECTED)
        now_s = table[-1, 0] if self._player is None and len(table) else 0.0
        message = "" if np.isfinite(table[:, 1:]).any() else "No positions."
        models.fill("positions", models.positions, _shown_errors(table, now_s), message)
        for kind, positions in ((TrackKind.RAW, own), (TrackKind.SECOND, second)):
            source = models.compared_positions[kind]
            columns = _error_columns(positions, TrackKind.CORRECTED if positions is second else kind)
            time_s, error_m, _ = _shown_errors(columns, now_s).T.astype(np.float32)
            source.data = {"time": time_s, kind.name.lower(): error_m}


def _error_columns(positions: Positions | None, kind: TrackKind) -> NDArray[np.float64]:
    return np.zeros((0, 3)) if positions is None else positions.error_columns(kind)


def _shown_errors(table: NDArray[np.float64], now_s: float) -> NDArray[np.float64]:
    return with_gaps(_thin(table - (now_s, 0.0, 0.0), 3 * MAX_POINTS), NO_DATA_S)


def _waterfall_image(traces: tuple[Trace, ...]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return one exchange per row, newest first, levels from -40 dB to its peak; uint8 (WATERFALL, width)."""
    image = np.zeros((WATERFALL, TRACE_BEFORE + TRACE_AFTER), np.uint8)
    for row, trace in enumerate(reversed(traces)):
        begin = trace.origin - TRACE_BEFORE - trace.cir.start_index
        low, high = max(begin, 0), min(begin + image.shape[1], len(trace.magnitude))
        magnitude = trace.magnitude[low:high]
        if low < high and (peak := float(magnitude.max())) > 0.0:
            level = 1.0 + np.log10(np.maximum(magnitude / peak, 1e-2)) / 2.0
            image[row, low - begin : high - begin] = (255.0 * level).astype(np.uint8)
    return image


def _rolling_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of the last `RATE_RANGES` known values, float64 (n,); NaN: there is none."""
    is_finite = np.isfinite(values)
    window = np.ones(RATE_RANGES)
    sums, counts = (
        np.convolve(column, window)[: len(values)] if len(values) else values
        for column in (np.where(is_finite, values, 0.0), is_finite.astype(np.float64))
    )
    mean: NDArray[np.float64] = np.divide(sums, counts, out=np.full(len(values), np.nan), where=counts > 0.0)
    return mean


def _thin(rows: NDArray[np.float64], limit: int = MAX_POINTS) -> NDArray[np.float64]:
    """Return at most about `limit` rows, at equal steps from the last one backwards."""
    return rows[:: -max(1, -(-len(rows) // limit))][::-1]


def _half_height(pose: Pose) -> float:
    """Return the extent of the ellipse of a pose in y, m."""
    major, minor, angle = pose.ellipse
    return math.hypot(drawable(major) * math.sin(angle), drawable(minor) * math.cos(angle))
