"""Write the texts of one page: verdict, figures, tables, notices."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from typing import Any

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning.determination import UNKNOWN_POSITION
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.headline import RECENT, Card, interval_cards, live_cards, recorded_positions
from uwb_mitigation.viewer.histories import NO_DATA_S, Pair
from uwb_mitigation.viewer.scene import Scene, plain_tag_id, tag_label, tag_name
from uwb_mitigation.viewer.state import PageState, no_data, set_rows
from uwb_mitigation.viewer.verdict import UNDETERMINED, WAITING, Verdict, verdict

LEVELS = ("OK", "WARN", "ERROR", "STALE")
"""Texts of the diagnostic levels."""

MAX_SHOWN_EVENTS = 8
STAMP_DIFFERENCE_S = 1.0
"""If the age of the latest range by its stamp and by its reception differ by more, the page says so."""


class Texts:
    """Writes everything that consists of text; all of it is from the same time."""

    def __init__(self, state: PageState) -> None:
        self._state, self._view, self._models = state, state.view, state.models
        self._player = state.view.player
        self._interval_cards: list[Card] = []
        self._states: dict[Any, str] = {}

    def draw(self, scene: Scene) -> None:
        """Write the texts of a scene."""
        cards = self._cards(scene)
        rows, pairs = self._pairs(scene)
        self._state.has_data = any(not row["no_data"] for row in rows)
        set_rows(self._models.pairs, rows)
        anchors = health.anchor_means(pairs)
        # If no anchor answers, the cause is not in each of them.
        is_lost = all(means["stopped"] > 0.0 for means in anchors.values())
        states = {
            anchor_id: health.UNKNOWN if is_lost else self._health(anchor_id, means)
            for anchor_id, means in anchors.items()
        }
        self._state.health = {key: (state, anchors[key]["residual"]) for key, state in states.items()}
        names = {anchor_id: place.name for anchor_id, place in scene.anchors.items() if place.name}
        notices = self._notices(scene)
        tag_id, timeline = self._state.tag_id, self._view.timeline
        tag = f"tag {'' if tag_id is None else format_id(tag_id)}"
        remedies = [line.partition(separator)[2] for separator in (f"{tag} determination: ", f"{tag}: {UNKNOWN_POSITION} ")
                    for line in notices if separator in line]  # fmt: skip
        of_tag = {pair[0]: means for pair, means in pairs.items() if pair[1] == tag_id}
        current = verdict(
            scene, tag_id, of_tag, {key: states[key] for key in of_tag}, next(iter(remedies), "")
        )
        if (
            self._player is not None
            and not (timeline and timeline.is_complete)
            and current.state == UNDETERMINED
        ):
            current = Verdict(WAITING, "the recording is being read")
        shown = self._state.verdict.update(current, scene.clock())
        reports = sorted((name, report.aged(scene.clock())) for name, report in scene.node_statuses.items())
        self._state.set(
            verdict=[shown.state, shown.reason, shown.action, self._facts(scene, shown.accuracy)],
            health=_anchor_rows(anchors, states, names),
            tag_rows=self._tags(scene, pairs),
            incidents=self._incidents(scene),
            cards=cards,
            nodes=[[name, LEVELS[min(report.level, 3)], report.message] for name, report in reports],
            notice=notices,
            summary=self._summary(scene),
        )

    def _health(self, key: Any, means: health.Means) -> str:
        self._states[key] = health.state(means, self._states.get(key, ""))
        return self._states[key]

    def _pairs(self, scene: Scene) -> tuple[list[dict[str, Any]], dict[Pair, health.Means]]:
        timeline, second = self._view.timeline, self._view.second
        rows, pairs = list[dict[str, Any]](), dict[Pair, health.Means]()
        for pair, history, sample in scene.latest():
            missing, age_s = no_data(scene, history), scene.age_s(history)
            means = history.statistics() | {
                "rate": 0.0 if missing else history.rate_hz(scene.stamp_age_s(pair)),
                "stopped": age_s if missing else 0.0,
                "displaced": 0.0 if timeline is None else timeline.displaced.get(pair[0], 0.0),
            }
            if timeline is not None and pair in timeline.losses:
                lost, received = timeline.losses[pair]
                means["lost"] = 100.0 * lost / max(lost + received, 1)
            other = None if second is None else second.scene.pairs.get(pair)
            compared = None if other is None else other.latest
            pairs[pair] = means
            rows.append(means | {
                "anchor": format_id(pair[0]), "tag": format_id(pair[1]), "state": self._health(pair, means),
                "status": missing or sample.status.name, "no_data": bool(missing), "raw": sample.raw_m,
                "corrected": sample.range_m, "second": compared.range_m if compared else math.nan, "sigma": sample.sigma_m,
            })  # fmt: skip
        return rows, pairs

    def _tags(self, scene: Scene, pairs: dict[Pair, health.Means]) -> list[list[str]]:
        """Return label, position, standard deviation, age and rate of each tag."""
        plain_id, ids = plain_tag_id(scene.tags, pairs), dict.fromkeys(sorted(tag for _, tag in pairs))
        names = {name: tag_label(name, plain_id) for name in scene.tags}
        rates = dict.fromkeys(names.values(), math.nan)
        for tag_id in ids:
            label = names.get(tag_name(tag_id, scene.tags, pairs), f"tag {format_id(tag_id)}")
            rates[label] = sum(
                np.nan_to_num(means["rate"]) for (_, tag), means in pairs.items() if tag == tag_id
            )
        views, rows = {label: scene.tags[name] for name, label in names.items()}, []
        for label, rate_hz in rates.items():
            place, sd_m, age = "-", math.nan, "no position"
            if (view := views.get(label)) is not None and (pose := view.pose) is not None:
                place, sd_m, age_s = f"{pose.x:.2f}, {pose.y:.2f}, {pose.z:.2f}", pose.sd_m, scene.age_s(view)
                age = f"no data for {age_s:.0f} s" if age_s > NO_DATA_S else f"{age_s:.1f} s"
            rows.append([label, place, _number(sd_m, 2), age, _number(rate_hz, 1)])
        return rows

    def _facts(self, scene: Scene, accuracy: str) -> str:
        """Return accuracy, age and share of corrected ranges."""
        tag_id, texts = self._state.tag_id, [accuracy] if accuracy else []
        if tag_id is not None and math.isfinite(stamp_s := scene.latest_stamp_s(tag_id)):
            texts.append(f"last range {scene.stamp_clock() - stamp_s:.1f} s old by stamp")
        if scene.ranges:
            corrected, count, faults = self._counts(scene)
            not_corrected = "no range corrected" + ("" if faults else ": no CIRs")
            share = f"{100.0 * corrected / count:.0f} % of ranges corrected"
            texts.append(share if corrected else not_corrected)
            cards = [card for card in self._interval_cards if corrected and card[0].startswith("Correction")]
            texts += [f"correction: {card[1]} ({card[2]})" for card in cards]
        return " \u00b7 ".join(texts)

    def _counts(self, scene: Scene) -> tuple[int, int, int]:
        """Return the numbers of corrected ranges, of all ranges, and of those with a status that needs attention."""
        timeline = self._view.timeline
        if timeline is None:
            return scene.corrected, scene.ranges, scene.faults
        return int(timeline.is_corrected.sum()), len(timeline.status), int(timeline.bad.sum())

    def _cards(self, scene: Scene) -> list[Card]:
        """Return the large figures."""
        state, player, timeline = self._state, self._player, self._view.timeline
        if player is None:
            self._interval_cards = live_cards(scene, state.tag_id)
            return self._interval_cards
        if timeline is None:
            return [["Reading the recording ...", "", ""]]
        second = None if self._view.second is None else self._view.second.timeline
        position_s = player.shown_s if state.window == RECENT else 0.0
        is_complete = timeline.is_complete, second is not None and second.is_complete
        if state.changed("cards", (state.window, state.tag_id, position_s, second is None, *is_complete)):
            self._interval_cards = interval_cards(timeline, second, state.tag_id, state.window, position_s)
        if not timeline.is_complete:
            return self._interval_cards
        positions = recorded_positions(timeline, state.tag_id)
        return positions.current_card(player.shown_s) + self._interval_cards

    def _summary(self, scene: Scene) -> str:
        """Return time and counts."""
        count = sum(1 for _ in scene.latest())
        corrected, ranges, _ = self._counts(scene)
        texts = [f"{count} pair{'' if count == 1 else 's'}", f"{corrected} corrected ranges of {ranges}"]
        if scene.dropped:
            texts.append(f"{scene.dropped} dropped by the viewer")
        if math.isfinite(now_s := scene.now_s(self._state.tag_id)):
            texts.insert(0, _utc(now_s))
        return " \u00b7 ".join(texts)

    def _notices(self, scene: Scene) -> list[str]:
        """Return the reasons for an empty page, and what needs attention."""
        histories = [history for _, history, _ in scene.latest()]
        missing, timeline, lines = self._view.missing, self._view.timeline, []
        if not histories:
            lines.append(missing.ranges)
        elif not self._state.has_data:
            lines.append(f"No ranges for {min(map(scene.age_s, histories)):.0f} s.")
        else:
            lines += self._ages(scene)
        lines += [
            "" if scene.anchors else missing.anchors,
            "" if scene.tags or scene.tracks else missing.positions,
        ]
        if timeline is not None:
            lines += [
                *timeline.notices,
                "" if timeline.is_complete else "Estimating the tracks of the recording ...",
            ]
        for status in scene.node_statuses.values():
            lines += status.aged(scene.clock()).determinations
        return [line for line in lines if line]

    def _ages(self, scene: Scene) -> list[str]:
        """Return notices on tags that have stopped, and on stamps that do not fit the clock."""
        lines = []
        for tag_id in dict.fromkeys(tag_id for (_, tag_id), _, _ in scene.latest()):
            age_s = min(scene.age_s(history) for (_, tag), history in scene.pairs.items() if tag == tag_id)
            latest_s = scene.latest_stamp_s(tag_id)
            behind_s = scene.stamp_clock() - latest_s - age_s
            if age_s > NO_DATA_S:
                lines.append(f"No ranges of tag {format_id(tag_id)} for {age_s:.0f} s.")
            elif self._player is None and abs(behind_s) > STAMP_DIFFERENCE_S:
                lines.append(
                    f"Stamps of tag {format_id(tag_id)} are {abs(behind_s):.1f} s {'old' if behind_s > 0 else 'in the future'} "
                    "when they arrive: the clocks differ, or ranges are delayed."
                )
        return lines

    def _incidents(self, scene: Scene) -> list[tuple[float | None, str]]:
        """Return the incidents: time in the recording, None if they are live; text."""
        if self._player is not None:
            return [] if self._view.timeline is None else list(self._view.timeline.incidents)
        scene.incidents.check(now_s := scene.clock())
        latest = list(scene.incidents.found)[-MAX_SHOWN_EVENTS:]
        return [(None, f"{now_s - time_s:.0f} s ago: {text}") for time_s, text in latest]


def _anchor_rows(
    anchors: dict[int, health.Means], states: dict[int, str], names: dict[int, str]
) -> list[list[str]]:
    """Return the texts of the table of anchors; advice for all of them is in the first row."""
    common, advice = health.advice(anchors, names)
    worst = health.BAD if health.BAD in states.values() else health.CHECK
    rows = [[worst, "all", "", "", "", "", common]] if common else []
    for anchor_id, means in anchors.items():
        digits = {"rate": 1, "nlos": 0, "residual": 2, "lost": 0}
        texts = [_number(means[name], count) for name, count in digits.items()]
        label = format_id(anchor_id) + (f" ({names[anchor_id]})" if anchor_id in names else "")
        rows.append([states[anchor_id], label, *texts, advice[anchor_id]])
    return rows


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _utc(time_s: float) -> str:
    try:
        return f"{datetime.fromtimestamp(time_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{time_s:.0f} s"
