"""Tables with the results of `train`, `train-universal` and `evaluate`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from uwb_mitigation.commands.support.console import print_line, show_table

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.training.comparison import Comparison, Coverage
    from uwb_mitigation.training.evaluation.accuracy import Accuracy
    from uwb_mitigation.training.evaluation.metrics import ErrorStatistics
    from uwb_mitigation.training.fit.selection import Selection
    from uwb_mitigation.training.train import TrainedBundle

_ROWS = {
    "raw": "raw",
    "overall_median": "overall median",
    "l1_line": "line",
    "float": "model, float",
    "int8": "model, int8",
}

_CANDIDATES = {
    "raw": "measured ranges",
    "cold start": "network trained in simulation, with an offset of this data",
    "constant": "one constant offset",
    "line": "linear bias model in the received powers",
    "line+network": "linear bias model, and a network for its residuals",
    "network": "a network only",
    "selection (nested)": "error of the selection, on data that it did not use",
}


def show_trained(trained: TrainedBundle) -> None:
    """Show the selection, the cross-validation and the verdict of `train`."""
    from uwb_mitigation.training.fit import candidates, selection

    if trained.selection is not None:
        show_selection(trained.selection)
    if trained.prefers_cold_start:
        print_line(
            f"With fewer than {candidates.MIN_CONFIGURATIONS} configurations, cold start is selected unless another candidate is "
            f"{selection.COLD_START_MIN_GAIN:.0%} better."
        )
    if "int8" in trained.validation.errors:
        rows = trained.validation.statistics().items()
        show_table(
            f"{trained.validation.folds}-fold cross-validation by configuration",
            ("", "MAE, m", "std, m", "p95, m"),
            [(_ROWS[name], *values.values()) for name, values in rows],
        )
    before, baseline = min((mae, name) for name, mae in trained.baseline_mae_m.items())
    change = trained.mae_m / before - 1 if before else 0.0
    verdict = "lower" if trained.improved else "higher, no improvement"
    print_line(
        f"MAE on held-out configurations: {trained.mae_m:.3f} m; best baseline, {_CANDIDATES[baseline]}: "
        f"{before:.3f} m: {abs(change):.0%} {verdict}"
    )
    if not trained.improved:
        print_line(f"Warning: the model is not better than {_CANDIDATES[baseline]}. Do not use it.")
    show_bundle(trained.bundle)


def show_selection(selection: Selection) -> None:
    """Show the held-out errors of the candidates."""
    show_table(
        f"{selection.configurations} configurations, {selection.folds} folds by configuration",
        ("candidate", "MAE, m", "", ""),
        [
            (row, mae, "<-" if row == selection.chosen else "", _CANDIDATES.get(row, ""))
            for row, mae in selection.mae().items()
        ],
        selection.chosen,
    )


def show_comparison(result: Comparison) -> None:
    """Show the table of `evaluate --cross-validate`."""
    labels, names = list(result.rows[0].by_label), [row.name for row in result.rows]

    def covered(coverage: Coverage) -> str:
        return ", ".join(
            f"{label or 'all'} {narrow:.1%} and {wide:.1%}" for label, (narrow, wide) in coverage.items()
        )

    show_table(
        f"{result.configurations} configurations, {result.folds} splits by configuration, "
        f"MAE in m, mean of {result.seeds} seeds",
        ("", "all, m", "std, m", "95 % interval, m", *(f"{label or 'no label'}, m" for label in labels)),
        [
            (row.name, row.mae_mean, row.mae_std, "{:.3f}-{:.3f}".format(*row.ci95), *row.by_label.values())
            for row in result.rows
        ],
        optional=("95 % interval, m", "std, m"),
    )
    after_rejection = ", ".join(f"{fraction:.0%}: {mae:.3f}" for fraction, mae in result.rejection)
    print_line(
        f"{'shipped_int8' if 'shipped_int8' in names else 'shipped_float'}: coverage of the 68 % and 95 % intervals: {covered(result.coverage)}\n"
        f"MAE after rejecting the share of ranges with the largest variances: {after_rejection}\n"
        f"not corrected, because out of distribution: {result.passed_through:.1%}"
    )
    if result.without_levels:
        print_line(f"{result.without_levels} ranges without receive or first-path level are left out")
    if result.universal_coverage is not None:
        print_line(
            f"universal_los_offset: coverage of the 68 % and 95 % intervals: {covered(result.universal_coverage)}"
        )


def show_held_out(held_out: Mapping[str, Mapping[str, ErrorStatistics]]) -> None:
    """Show the table of `train-universal`."""
    rows = [(row, *(statistics.mae for statistics in by.values())) for row, by in held_out.items()]
    show_table(
        "MAE in held-out simulated buildings", ("", *(f"{label}, m" for label in held_out["raw"])), rows
    )


def show_bundle(bundle: Bundle) -> None:
    """Show file, size and id of a bundle."""
    kind = "int8" if bundle.card.quantised else "float32"
    print_line(f"{bundle.path}: {kind}, {len(bundle.model)} bytes, model id {bundle.model_id:08x}")


def show_accuracy(result: Accuracy) -> None:
    """Show the table of `evaluate`."""
    after = result.corrected
    rows: list[tuple[object, ...]] = [("all", result.n, result.raw.mae, after.mae, after.std, after.p95)]
    rows += [(label or "no label", *values, "", "") for label, values in result.by_label.items()]
    columns = ("", "ranges", "raw MAE, m", "corrected MAE, m", "std, m", "p95, m")
    show_table(f"{result.n} ranges, model {result.model_id:08x}", columns, rows, optional=columns[4:])
    for status, count in result.statuses.items():
        if status != "OK":
            print_line(f"{status}: {count} ranges" + " not corrected" * (status != "UNRELIABLE"))
    if result.trained_on:
        print_line(
            f"The result is optimistic: {len(result.trained_on)} of {len(result.by_configuration)} configurations are in the "
            "training data of the model. --cross-validate shows the error on held-out configurations."
        )
