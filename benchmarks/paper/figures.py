"""Draw the figures with matplotlib. The same data gives the same picture."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.results import Box, RangeTest, Spread
from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:
    if (error.name or "").split(".")[0] != "matplotlib":
        raise
    raise MissingDependencyError("figures need matplotlib", valid="run `make setup-training`") from error

MAX_POINTS = 4000
MAX_NAMED = 12
"""With more groups there is no legend, because the colours would be too similar."""

_COLOURS = [
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
]
_MARKERS = "osD^vPX*<>hp"
_SETTINGS = {
    "font.family": "DejaVu Sans",
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "svg.hashsalt": "uwb-mitigation",
    # Names come from files: do not interpret dollar signs as math.
    "text.parse_math": False,
}


@contextmanager
def _drawing() -> Iterator[None]:
    with matplotlib.rc_context(), warnings.catch_warnings():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)  # type: ignore[arg-type]
        warnings.simplefilter("ignore", UserWarning)  # characters that the font does not contain
        yield


def samples(examples: Sequence[tuple[str, float, NDArray[np.floating]]]) -> str:
    """Draw Fig. 3: (propagation condition, error in m, amplitudes) one above the other. Return a `data:` URI."""
    with _drawing():
        figure = Figure(figsize=(7.2, 1.0 + 1.7 * len(examples)), layout="constrained")
        axes = np.atleast_1d(figure.subplots(len(examples), 1, sharex=True))
        for panel, (label, error_m, amplitudes), colour in zip(axes, examples, _COLOURS, strict=False):
            time_ns = (np.arange(len(amplitudes)) - WINDOW_LEAD) * SAMPLE_PERIOD_S * 1e9
            panel.plot(time_ns, amplitudes, color=colour, linewidth=1.4)
            panel.axvline(0, color="#555555", linestyle="--", linewidth=1)
            panel.set(ylim=(0, 1.08), ylabel="amplitude")
            panel.set_title(f"{label}: range error {error_m:+.3f} m", loc="left", fontsize=10)
        axes[-1].set_xlabel("time after the first path reported by the radio, ns")
        return _svg(figure)


def scatter(points: NDArray[np.floating], groups: NDArray[np.str_], title: str) -> str:
    """Draw Fig. 4: points (n, 3), coloured by group (n,), from two sides. Return a `data:` URI."""
    names, index, counts = np.unique(groups, return_inverse=True, return_counts=True)
    order = np.argsort(-counts, kind="stable").tolist()
    named = len(order) <= MAX_NAMED
    spectrum = matplotlib.colormaps["turbo"](np.linspace(0.03, 0.97, len(order)))
    with _drawing():
        figure = Figure(figsize=(7.6, 4.6), dpi=150)
        for side, azimuth in enumerate((-60, 30)):
            panel: Any = figure.add_axes((0.02 + 0.51 * side, 0.16, 0.44, 0.77), projection="3d")
            panel.view_init(elev=22, azim=azimuth)
            for rank, group in enumerate(order):
                panel.scatter(
                    *points[index == group].T,
                    s=7,
                    alpha=0.65,
                    linewidths=0,
                    color=_COLOURS[rank] if named else spectrum[rank],
                    marker=_MARKERS[rank] if named else "o",
                    label=f" {names[group]}",
                )
            panel.set(xlabel="component 1", ylabel="component 2", zlabel="component 3")
            for axis in (panel.xaxis, panel.yaxis, panel.zaxis):
                axis.labelpad = -7
            panel.tick_params(labelsize=7, pad=-3)
            panel.locator_params(nbins=5)
        figure.suptitle(title, fontsize=11, y=0.985)
        if named:
            figure.legend(
                *panel.get_legend_handles_labels(), loc="lower center", ncols=4, fontsize=9, markerscale=2
            )
        image = io.BytesIO()
        FigureCanvasAgg(figure)
        figure.savefig(image, format="png", metadata={"Software": None})
        return f"data:image/png;base64,{base64.b64encode(image.getvalue()).decode()}"


def range_test(result: RangeTest, paper_rate: float) -> str:
    """Draw the loss over the learning rate, and the paper's rate. Return a `data:` URI."""
    with _drawing():
        figure = Figure(figsize=(7.2, 3.6), layout="constrained")
        axes = figure.subplots()
        axes.plot(result.rates, result.losses_m, color=_COLOURS[0], linewidth=1.4)
        axes.axvspan(result.falls_from, result.falls_to, color="#dddddd", label="the loss falls")
        axes.axvline(paper_rate, color=_COLOURS[1], linestyle="--", label=f"paper: {paper_rate:g}")
        # Beyond the smallest loss, training diverges.
        top = 2.0 * result.losses_m[0]
        axes.set(xscale="log", xlabel="learning rate", ylabel="training MAE, m", ylim=(0, top))
        # The default labels are math text, which is disabled.
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(fontsize=8)
        return _svg(figure)


def over_k(
    boxes: Mapping[str, Box | None],
    statistics: Mapping[int, Mapping[str, Spread]],
    paper_mae: Mapping[int, float],
    windows: Sequence[int],
) -> str:
    """Draw Fig. 5: a box plot of errors, and below it MAE in LOS and NLOS and sigma over K. Return a `data:` URI.

    Args:
        boxes: {name: quantiles of errors, m}; None: not measured.
        statistics: {K: {`los`, `nlos`, `sigma`: spread over seeds}}.
        paper_mae: {K: MAE, m}.
        windows: every K, in the order to show.
    """
    with _drawing():
        figure = Figure(figsize=(7.6, 7.0), layout="constrained")
        box_axes, bar_axes = figure.subplots(2, 1, height_ratios=(3, 2))
        _draw_boxes(box_axes, boxes)
        _draw_bars(bar_axes, statistics, paper_mae, windows)
        return _svg(figure)


def _draw_boxes(axes: Axes, boxes: Mapping[str, Box | None]) -> None:
    shown = {position: box for position, box in enumerate(boxes.values()) if box is not None}
    keys = ("whislo", "q1", "med", "q3", "whishi")
    drawn = axes.bxp(
        [dict(zip(keys, box, strict=True)) for box in shown.values()],
        positions=list(shown),
        widths=0.6,
        showfliers=False,
        patch_artist=True,
        medianprops={"color": "#000000", "linewidth": 1.6},
    )
    for name, patch in zip((list(boxes)[position] for position in shown), drawn["boxes"], strict=True):
        patch.set_facecolor("#bbbbbb" if name.startswith("raw") else "#56B4E9")
    axes.axhline(0, color="#555555", linewidth=1)
    axes.set(xlim=(-0.6, len(boxes) - 0.4), ylabel="range error, m")
    axes.set_xticks(range(len(boxes)), list(boxes))
    axes.set_title("Errors: median, quartiles, 5th and 95th percentile", loc="left", fontsize=10)
    _mark_gaps(axes, [index for index in range(len(boxes)) if index not in shown])


def _draw_bars(
    axes: Axes,
    statistics: Mapping[int, Mapping[str, Spread]],
    paper_mae: Mapping[int, float],
    windows: Sequence[int],
) -> None:
    kinds = {"los": ("LOS MAE", "//"), "nlos": ("NLOS MAE", ""), "sigma": ("σ, all", "..")}
    for number, (kind, (name, hatch)) in enumerate(kinds.items()):
        means = {
            index: statistics[k][kind] for index, k in enumerate(windows) if kind in statistics.get(k, {})
        }
        axes.bar(
            np.array(list(means)) + 0.25 * (number - 1),
            [spread.mean for spread in means.values()],
            0.23,
            yerr=[spread.std or 0.0 for spread in means.values()],
            capsize=2,
            color=_COLOURS[number],
            hatch=hatch,
            edgecolor="white",
            label=name,
        )
    marked = [(index, paper_mae[k]) for index, k in enumerate(windows) if k in paper_mae]
    label = "paper: MAE of all, int8"
    axes.plot(*zip(*marked, strict=True), "_k", markersize=20, markeredgewidth=2, label=label)
    axes.legend(ncols=2, fontsize=8, loc="upper left", markerscale=0.6)
    axes.set(xlim=(-0.6, len(windows) - 0.4), ylim=(0, axes.get_ylim()[1] * 1.5), ylabel="m")
    axes.set_xticks(range(len(windows)), [f"K = {k}" for k in windows])
    axes.set_title("After correction, mean and standard deviation over seeds", loc="left", fontsize=10)
    _mark_gaps(axes, [index for index, k in enumerate(windows) if k not in statistics])


def _mark_gaps(axes: Axes, positions: Sequence[int]) -> None:
    style: dict[str, Any] = {"rotation": 90, "ha": "center", "va": "center", "fontsize": 9}
    for position in positions:
        axes.text(position, 0.3, "not measured", transform=axes.get_xaxis_transform(), **style)


def _svg(figure: Figure) -> str:
    text = io.BytesIO()
    # Without the metadata block: it contains URLs, and the page does not refer to external resources.
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue()).decode()}"
