"""Draws the figures of a report with matplotlib: arrays in, an image in a `data:` URI out. The only place that
imports matplotlib; nothing here depends on the time or on a display, so that the same data gives the same page."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.evaluation.projection import Projection
from uwb_mitigation.evaluation.results import Spread
from uwb_mitigation.evaluation.study import Box, Example
from uwb_mitigation.measurement import SAMPLE_PERIOD_S
from uwb_mitigation.preprocessing import WINDOW_LEAD

try:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
except ModuleNotFoundError as error:
    if (error.name or "").split(".")[0] != "matplotlib":
        raise
    raise MissingDependencyError(
        "a report's figures need matplotlib", valid="run `make setup-training`"
    ) from error

MAX_POINTS = 4000
MAX_NAMED = 12
"""More groups than that get no legend: nobody can tell their colours apart."""

_LAYERS = 4

_COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#7F3C8D",
    "#666666",
    "#B8A800",
    "#8C510A",
    "#00A6A6",
    "#1A1A1A",
)
_MARKERS = "osD^vPX*<>hp"
_SETTINGS = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "svg.hashsalt": "uwb-mitigation",
    "svg.fonttype": "path",
    # Names come from files: a dollar sign in one is a dollar sign.
    "text.parse_math": False,
    "text.usetex": False,
}


@contextmanager
def _settings() -> Iterator[None]:
    with matplotlib.rc_context(), warnings.catch_warnings():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)  # type: ignore[arg-type]
        # A character that the font lacks is drawn as a box; that is no news for the command line.
        warnings.simplefilter("ignore", UserWarning)
        yield


def samples(examples: Sequence[Example]) -> str:
    """Fig. 3: windows of each propagation condition, one above the other."""
    with _settings():
        figure = Figure(figsize=(7.2, 1.0 + 1.7 * len(examples)), layout="constrained")
        axes = np.atleast_1d(figure.subplots(len(examples), 1, sharex=True))
        for place, example, colour in zip(axes, examples, _COLOURS, strict=False):
            time_ns = (np.arange(len(example.amplitudes)) - WINDOW_LEAD) * SAMPLE_PERIOD_S * 1e9
            place.plot(time_ns, example.amplitudes, color=colour, linewidth=1.4)
            place.axvline(0, color="#555555", linestyle="--", linewidth=1)
            place.set(ylim=(0, 1.08), ylabel="amplitude")
            place.set_title(f"{example.label}: range error {example.error_m:+.3f} m", loc="left", fontsize=10)
        axes[-1].set_xlabel("time after the first path found by the radio, ns")
        return _svg(figure)


def scatter(projection: Projection, groups: NDArray[np.str_], title: str) -> str:
    """Fig. 4: points (n, 3) in three dimensions, a colour for each group (n,), from two sides."""
    names, counts = np.unique(groups, return_counts=True)
    order = names[np.argsort(-counts, kind="stable")].tolist()
    named = len(order) <= MAX_NAMED
    # One marker is drawn at a time: groups in layers, a part of each, or the last would hide the rest.
    members = [np.flatnonzero(groups == name) for name in order]
    layers = [(rows[start::_LAYERS], n) for start in range(_LAYERS) for n, rows in enumerate(members)]
    layers = [(rows, n) for rows, n in layers if len(rows)] if named else [(np.arange(len(groups)), 0)]
    with _settings():
        spectrum = matplotlib.colormaps["turbo"](np.linspace(0.03, 0.97, len(order)))
        colours = np.empty((len(groups), 4))
        for number, rows in enumerate(members):
            colours[rows] = to_rgba(_COLOURS[number]) if named else spectrum[number]
        figure = Figure(figsize=(7.6, 4.6 if named else 4.0), dpi=150)
        for side, azimuth in enumerate((-60, 30)):
            bottom = 0.16 if named else 0.03
            place: Any = figure.add_axes((0.02 + 0.51 * side, bottom, 0.44, 0.93 - bottom), projection="3d")
            place.view_init(elev=22, azim=azimuth)
            place.set_box_aspect((1, 1, 0.8), zoom=1.0)
            place.computed_zorder = False
            for rows, number in layers:
                place.scatter(
                    *projection.points[rows].T,
                    s=7,
                    alpha=0.65,
                    linewidths=0,
                    c=colours[rows],
                    marker=_MARKERS[number] if named else "o",
                    depthshade=False,
                )
            place.set_xlabel("component 1", labelpad=-8)
            place.set_ylabel("component 2", labelpad=-8)
            place.set_zlabel("component 3", labelpad=-6)
            place.tick_params(labelsize=7, pad=-3)
            place.locator_params(nbins=5)
        figure.suptitle(title, fontsize=11, y=0.985)
        if named:
            handles = [
                Line2D([], [], linestyle="", marker=_MARKERS[number], color=_COLOURS[number], markersize=6)
                for number in range(len(order))
            ]
            shown = [f"{name} " if not name.startswith("_") else f" {name}" for name in order]
            figure.legend(handles, shown, loc="lower center", ncols=4, frameon=False, fontsize=9)
        return _png(figure)


def over_k(
    raw: Mapping[str, Box],
    boxes: Mapping[int, Box],
    left: Mapping[int, Mapping[str, Spread]],
    paper_mae: Mapping[int, float],
    windows: Sequence[int],
) -> str:
    """Fig. 5: errors over the window length K, and below LOS MAE, NLOS MAE and sigma.

    Args:
        raw: boxes before correction, by part.
        boxes: of the errors left, by K; where one is missing the figure says so.
        left: {K: {`los`, `nlos`, `sigma`: spread over seeds}}.
        paper_mae: by K, for comparison.
        windows: every K, in the order to show.
    """
    with _settings():
        figure = Figure(figsize=(7.6, 7.0), layout="constrained")
        above, below = figure.subplots(2, 1, height_ratios=(3, 2))
        names = [*(f"raw\n{part}" for part in raw), *(f"K = {k}" for k in windows)]
        shown = dict(enumerate(raw.values())) | {
            len(raw) + number: boxes[k] for number, k in enumerate(windows) if k in boxes
        }
        drawn = above.bxp(
            [
                {"whislo": b.low, "q1": b.first, "med": b.median, "q3": b.third, "whishi": b.high}
                for b in shown.values()
            ],
            positions=list(shown),
            widths=0.6,
            showfliers=False,
            patch_artist=True,
            medianprops={"color": "#000000", "linewidth": 1.6},
        )
        for position, patch in zip(shown, drawn["boxes"], strict=True):
            patch.set_facecolor("#bbbbbb" if position < len(raw) else "#56B4E9")
        above.axhline(0, color="#555555", linewidth=1)
        above.set_xlim(-0.6, len(names) - 0.4)
        above.set_xticks(range(len(names)), names)
        above.set_ylabel("range error, m")
        above.set_title("Errors: median, quartiles, 5th and 95th percentile", loc="left", fontsize=10)
        _say_missing(above, [len(raw) + n for n, k in enumerate(windows) if k not in boxes])
        _bars(below, left, paper_mae, windows)
        return _svg(figure)


def _bars(
    place: Any,
    left: Mapping[int, Mapping[str, Spread]],
    paper_mae: Mapping[int, float],
    windows: Sequence[int],
) -> None:
    kinds = (
        ("los", "LOS MAE", "#0072B2", ""),
        ("nlos", "NLOS MAE", "#D55E00", "//"),
        ("sigma", "σ, all", "#999999", ".."),
    )
    handles: list[Any] = []
    for number, (kind, name, colour, hatch) in enumerate(kinds):
        for position, k in enumerate(windows):
            spread = left.get(k, {}).get(kind)
            if spread is None:
                continue
            place.bar(
                position + 0.25 * (number - 1),
                spread.mean,
                0.23,
                yerr=spread.std or None,
                capsize=2,
                color=colour,
                hatch=hatch,
                edgecolor="white",
                ecolor="#000000",
            )
        handles.append(Patch(facecolor=colour, hatch=hatch, edgecolor="white", label=name))
    positions = [position for position, k in enumerate(windows) if k in paper_mae]
    handles += place.plot(
        positions,
        [paper_mae[windows[position]] for position in positions],
        linestyle="",
        marker="_",
        markersize=26,
        markeredgewidth=2,
        color="#000000",
        label="paper: MAE, int8",
    )
    handles[-1].set_zorder(5)
    place.legend(
        handles=[
            *handles[:-1],
            Line2D(
                [],
                [],
                color="#000000",
                marker="_",
                linestyle="",
                markersize=12,
                markeredgewidth=2,
                label="paper: MAE of all, int8",
            ),
        ],
        ncols=2,
        fontsize=8,
        loc="upper left",
    )
    place.set_xlim(-0.6, len(windows) - 0.4)
    # Room for the legend above the highest bar.
    place.set_ylim(0, place.get_ylim()[1] * 1.5)
    place.set_xticks(range(len(windows)), [f"K = {k}" for k in windows])
    place.set_ylabel("m")
    place.set_title("What is left, mean and standard deviation over seeds", loc="left", fontsize=10)
    _say_missing(place, [position for position, k in enumerate(windows) if k not in left])


def _say_missing(place: Any, positions: Sequence[int]) -> None:
    for position in positions:
        place.text(
            position,
            0.5 if place.get_ylim()[0] < 0 else 0.33,
            "not measured",
            transform=place.get_xaxis_transform(),
            rotation=90,
            ha="center",
            va="center",
            fontsize=9,
            color="#555555",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )


def _svg(figure: Figure) -> str:
    text = io.BytesIO()
    # Its own metadata block names addresses on the web, which a page without external resources should not hold.
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue()).decode()}"


def _png(figure: Figure) -> str:
    FigureCanvasAgg(figure)
    image = io.BytesIO()
    figure.savefig(image, format="png", metadata={"Software": None})
    return f"data:image/png;base64,{base64.b64encode(image.getvalue()).decode()}"
