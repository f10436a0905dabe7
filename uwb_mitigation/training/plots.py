"""Drawings of a search and of a learning-rate range test, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import MissingDependencyError, UwbMitigationError
from uwb_mitigation.training.learning_rate import RangeTest
from uwb_mitigation.training.search import Trial, front


def draw_front(trials: Sequence[Trial], path: Path) -> None:
    """MAE against multiply-accumulates, the front marked and named.

    Raises:
        MissingDependencyError: there is no matplotlib. UwbMitigationError: the file cannot be written.
    """
    figure, axes = _figure()
    measured = [trial for trial in trials if trial.mae_m is not None]
    axes.scatter([t.multiply_accumulates for t in measured], [t.mae_m for t in measured], s=14, color="0.65")
    best = front(trials)
    axes.plot(
        [t.multiply_accumulates for t in best], [t.mae_m for t in best], "o-", color="C0", label="front"
    )
    for trial in best:
        shape = trial.architecture
        axes.annotate(
            f"K{shape.samples} N{shape.modules} F{shape.filters}",
            (trial.multiply_accumulates, trial.mae_m),
            xytext=(3, 4),
            textcoords="offset points",
            fontsize=7,
        )
    axes.set(xscale="log", xlabel="multiply-accumulates of one inference", ylabel="validation MAE (m)")
    axes.legend()
    _save(figure, path)


def draw_range_test(result: RangeTest, path: Path) -> None:
    """The smoothed loss against the learning rate.

    Raises:
        MissingDependencyError: there is no matplotlib. UwbMitigationError: the file cannot be written.
    """
    figure, axes = _figure()
    axes.plot(result.rates, result.losses_m)
    axes.axvline(result.suggested, color="C2", linestyle="--", label=f"steepest: {result.suggested:.1e}")
    axes.axvline(result.highest, color="C3", linestyle=":", label=f"least loss: {result.highest:.1e}")
    axes.set(xscale="log", xlabel="learning rate", ylabel="training MAE (m), smoothed")
    axes.legend()
    _save(figure, path)


def _figure() -> tuple[Any, Any]:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise MissingDependencyError("drawing needs matplotlib", valid="run `make setup-training`") from error
    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _save(figure: Any, path: Path) -> None:
    try:
        figure.savefig(path, format="png")
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(path)) from error
