"""Write the texts of one page: verdict, figures, tables, notices."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.determination import UNKNOWN_POSITION
from uwb_mitigation.positioning.health import NO_DATA_S, Means, Verdict
from uwb_mitigation.positioning.residual_directions import ResidualDirections, displaced_anchor
from uwb_mitigation.viewer.headline import Card, cards
from uwb_mitigation.viewer.histories import HISTORY_S, RATE_RANGES, STATISTICS, Pair
from uwb_mitigation.viewer.scene import Scene, plain_tag_id, tag_label, tag_name
from uwb_mitigation.viewer.state import PageState, new_source, set_rows
from uwb_mitigation.viewer.verdict import STATES, HeldVerdict, anchor_means, verdict

LEVELS = ("OK", "WARN", "ERROR", "STALE")
"""Texts of the diagnostic levels."""

_RANGES = f"last {STATISTICS} ranges"

COLUMNS = {
    "state": ("state", "", STATES),
    "status": ("status", "last range", "whether the network could correct the range"),
    "raw": ("raw, m", "last range", "measured range"),
    "corrected": ("corrected, m", "last range", "corrected range"),
    "sigma": ("sd, m", "last range", "standard deviation of the corrected range"),
    "correction": ("correction, m", _RANGES, "mean of raw minus corrected range"),
    "residual": ("residual, m", _RANGES, "mean of corrected range minus distance to the estimated position"),
    "not_ok": ("not OK, %", _RANGES, "share of ranges whose status is not OK"),
    "nlos": ("NLOS, %", _RANGES, "share of CIRs without line of sight: first path 6 dB below the total"),
    "rx": ("RX, dBm", _RANGES, "mean receive level"),
    "rate": ("rate, Hz", f"last {RATE_RANGES} ranges", "ranges per second"),
    "lost": ("lost, %", f"last {HISTORY_S:.0f} s", "share of missing sequence numbers"),
}
"""Columns of the table of pairs after anchor and tag: {field: (title, interval, description)}."""

ANCHOR_TITLES = "state", "anchor", "rate, Hz", "NLOS, %", "residual, m", "lost, %", "advice"
TAG_TITLES = "tag", "position", "x, y, z, m", "sd, m", "position age", "ranges, Hz", "range age by stamp"
"""Columns of the tables of anchors and of tags."""
MAX_SHOWN_EVENTS = 8


class Texts:
    """Writes everything that consists of text; all of it is from the same time.

    Attributes:
        pairs: source of the table of pairs.
    """

    def __init__(self, page: PageState) -> None:
        self._page, self._view = page, page.view
        self.pairs = new_source("anchor", "tag", "no_data", *COLUMNS, name="pairs")
        self._cards: list[Card] = []
        self._states: dict[Any, str] = {}
        self._verdicts = defaultdict[int | None, HeldVerdict](HeldVerdict)

    def draw(self, scene: Scene) -> None:
        """Write the texts of a scene."""
        page, timeline = self._page, self._view.timeline
        state = page.tag_id, timeline.is_read, timeline.is_complete
        if self._view.player is None or page.changed("cards", state):
            self._cards = cards(self._view, page.tag_id)
        pairs = self._pairs(scene)
        anchors = anchor_means(pairs)
        # If no anchor answers, the cause is not in each of them.
        is_lost = all(means["stopped"] > 0.0 for means in anchors.values())
        states = dict.fromkeys(scene.anchors, health.SILENT) | {
            key: health.SILENT if is_lost else self._health(key, means) for key, means in anchors.items()
        }
        page.health = {key: (states[key], means["residual"]) for key, means in anchors.items()}
        names = {anchor_id: place.name for anchor_id, place in scene.anchors.items() if place.name}
        notices = self._notices(scene)
        of_tags: dict[int | None, dict[int, Means]] = {page.tag_id: {}}
        for (anchor_id, of_tag), means in pairs.items():
            of_tags.setdefault(of_tag, {})[anchor_id] = means
        verdicts = {
            tag_id: self._verdict(scene, tag_id, means_of, states, notices)
            for tag_id, means_of in of_tags.items()
        }
        for tag_id in self._verdicts.keys() - verdicts.keys():
            del self._verdicts[tag_id]
        shown = verdicts[page.tag_id]
        tag = f" of tag {format_id(page.tag_id or 0)}" if len(verdicts) > 1 else ""
        reports = sorted((name, report.aged(scene.clock())) for name, report in scene.node_statuses.items())
        page.controls.update(
            headline=shown.headline(tag),
            verdict=[*shown[:3], *self._facts(scene, shown.accuracy)],
            health=_anchor_rows(anchors, states, names),
            tag_rows=_tag_rows(scene, pairs, verdicts),
            incidents=self._incidents(scene),
            cards=self._cards,
            nodes=[[name, LEVELS[min(report.level, 3)], report.message] for name, report in reports],
            notice=notices,
        )

    def _health(self, key: Any, means: Means) -> str:
        self._states[key] = health.state(means, self._states.get(key, ""))
        return self._states[key]

    def _pairs(self, scene: Scene) -> dict[Pair, Means]:
        """Write the table of pairs; return their means."""
        displaced = self._view.timeline.displaced
        rows, pairs = list[tuple[Any, ...]](), dict[Pair, Means]()
        by_tag = defaultdict[int, dict[Pair, ResidualDirections]](dict)
        for pair, history, _ in scene.latest():
            by_tag[pair[1]][pair] = history.directions
        moved = dict(filter(None, map(displaced_anchor, by_tag.values())))
        moved_tags = {tag_id for _, tag_id in moved}
        for pair, history, sample in scene.latest():
            missing, age_s = scene.no_data(history), scene.age_s(sample)
            means = dict.fromkeys(history.statistics(), math.nan) if missing else history.statistics()
            means |= {
                "rate": 0.0 if missing else history.rate_hz(scene.stamp_age_s(pair)),
                "stopped": age_s if missing else 0.0,
                "displaced": moved.get(pair, 0.0),
            }
            if pair[0] in displaced.keys() & scene.anchors.keys():
                residual_m, place = displaced[pair[0]]
                x, y = place.position[:2]
                moved_m = math.dist((x, y), scene.anchors[pair[0]].position[:2])
                means |= {"displaced": residual_m, "fit_x": x, "fit_y": y, "moved": moved_m}
            if displaced or pair[1] in moved_tags:
                # A displaced anchor bends the track with which all are compared.
                means |= {"residual": math.nan, "evidence": 0.0}
            pairs[pair] = means
            status, ids = missing or sample.status.name, map(format_id, pair)
            measured = sample.raw_m, sample.corrected_m, sample.sigma_m
            shown = (means[name] for name in list(COLUMNS)[5:])
            rows.append((*ids, bool(missing), self._health(pair, means), status, *measured, *shown))
        self._page.has_data = any(means["stopped"] == 0.0 for means in pairs.values())
        set_rows(self.pairs, rows)
        return pairs

    def _verdict(
        self,
        scene: Scene,
        tag_id: int | None,
        anchors: dict[int, Means],
        states: dict[int, str],
        notices: list[str],
    ) -> Verdict:
        """Return the verdict on a tag, which is better only after a while."""
        tag = f"tag {'' if tag_id is None else format_id(tag_id)}"
        texts = (f"{tag} determination: ", f"{tag}: {UNKNOWN_POSITION} ")
        remedies = (line.partition(text)[2] for text in texts for line in notices if text in line)
        current = verdict(scene, tag_id, anchors, states, next(remedies, ""))
        is_complete = self._view.timeline.is_complete
        if current.state in (health.UNDETERMINED, health.WAITING) and not is_complete:
            current = Verdict(health.WAITING, "the recording is being read")
        return self._verdicts[tag_id].update(current, scene.clock())

    def _facts(self, scene: Scene, accuracy: str) -> tuple[str, str]:
        """Return accuracy and age, and a line for each interval: what the correction changes, share of corrected ranges."""
        texts = [accuracy] if accuracy else []
        if math.isfinite(stamp_s := scene.latest_stamp_s(self._page.tag_id)):
            texts.append(f"last range {scene.stamp_clock() - stamp_s:.1f} s old by stamp")
        if scene.dropped:
            texts.append(f"{scene.dropped} ranges dropped by the viewer")
        lines, dot = defaultdict[str, list[str]](list), " \u00b7 "
        for title, value, text in self._cards:
            name, _, interval = title.partition(", ")
            if name in ("Ranges corrected", "Correction"):
                lines[f"{interval.capitalize()}: "].append(f"{name.lower()}: {value} ({text})")
        return dot.join(texts), "\n".join(interval + dot.join(facts) for interval, facts in lines.items())

    def _notices(self, scene: Scene) -> list[str]:
        """Return the reasons for an empty page, and what needs attention."""
        timeline, has_positions = self._view.timeline, scene.tags or scene.tracks
        shown = {"ranges": any(scene.latest()), "anchors": scene.anchors, "positions": has_positions}
        lines = [text for name, text in scene.missing.items() if not shown[name]]
        if timeline.is_read:
            lines += timeline.notices
            lines.append("" if timeline.is_complete else "Estimating the tracks of the recording ...")
        for status in scene.node_statuses.values():
            lines += status.aged(scene.clock()).determinations
        return [line for line in lines if line]

    def _incidents(self, scene: Scene) -> list[tuple[float | None, str]]:
        """Return the incidents: time in the recording, None if they are live; text."""
        incidents, now_s = self._view.all_data.incidents, scene.clock()
        latest, shown = incidents.latest, list[tuple[float | None, str]](incidents.all())
        if self._view.player is None:
            incidents.check(now_s)
            latest = incidents.latest[-MAX_SHOWN_EVENTS:]
            shown = [(None, f"{now_s - time_s:.0f} s ago: {text}") for time_s, text in latest]
        hidden = incidents.count - len(latest)
        return [(None, f"{hidden} earlier events are not shown"), *shown] if hidden else shown


def _tag_rows(scene: Scene, pairs: dict[Pair, Means], verdicts: dict[int | None, Verdict]) -> list[list[str]]:
    """Return the texts of the table of tags; those with positions come first, in the order of their colours."""
    plain_id, rows = plain_tag_id(scene.tags, pairs), dict[str, list[str]]()
    for name, pose in sorted(scene.tags.items()):
        label, age_s = tag_label(name, plain_id), scene.age_s(pose)
        place, sd_m, age = f"{pose.x:.2f}, {pose.y:.2f}, {pose.z:.2f}", pose.sd_m, f"{age_s:.1f} s"
        if age_s > NO_DATA_S:
            place, sd_m, age = f"last: {place}", math.nan, f"no data for {age_s:.0f} s"
        rows[label] = [label, "-", place, _number(sd_m, 2), age, "-", "-"]
    for tag_id in sorted({tag_id for _, tag_id in pairs}):
        label, name = f"tag {format_id(tag_id)}", tag_name(tag_id, scene.tags, pairs)
        label = tag_label(name, plain_id) if name else label
        row = rows.setdefault(label, [label, "", "-", "-", "no position", "", ""])
        rate_hz = sum(np.nan_to_num(means["rate"]) for (_, tag), means in pairs.items() if tag == tag_id)
        row[1] = verdicts[tag_id].state
        row[5:] = _number(rate_hz, 1), f"{scene.stamp_clock() - scene.latest_stamp_s(tag_id):.1f} s"
    return list(rows.values())


def _anchor_rows(anchors: dict[int, Means], states: dict[int, str], names: dict[int, str]) -> list[list[str]]:
    """Return the texts of the table of anchors; advice for all of them is in the first row."""
    common, advice = health.advice(anchors, names)
    worst = health.BAD if health.BAD in states.values() else health.CHECK
    rows = [[worst, "all", "", "", "", "", common]] if common else []
    for anchor_id in sorted(states):
        digits, means = {"rate": 1, "nlos": 0, "residual": 2, "lost": 0}, anchors.get(anchor_id, {})
        texts = [_number(means.get(name, math.nan), count) for name, count in digits.items()]
        label = format_id(anchor_id) + (f" ({names[anchor_id]})" if anchor_id in names else "")
        rows.append([states[anchor_id], label, *texts, advice.get(anchor_id, "")])
    return rows


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
