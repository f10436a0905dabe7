"""The tables in which `train` and `evaluate` show their results to a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import Table

if TYPE_CHECKING:
    from uwb_mitigation.evaluation.accuracy import Accuracy
    from uwb_mitigation.model.bundle import Bundle
    from uwb_mitigation.training.choosing import Choice
    from uwb_mitigation.training.comparison import Comparison
    from uwb_mitigation.training.making import Made
    from uwb_mitigation.training.recipe import CrossValidation

# Seen in rows of the cross-validation table, in this order.
_ROWS = {
    "raw": "raw",
    "overall_median": "overall median",
    "l1_line": "line",
    "float": "model, float",
    "int8": "model, int8",
}


# What the candidates of `train` are, by their names.
_CANDIDATES = {
    "raw": "as measured",
    "as shipped": "the model that was started from",
    "own offset": "the same with another offset",
    "cold start": "a simulator-trained network with an offset of these",
    "line and cold start": "mean of the line and that",
    "trained further": "the network that was started from, trained on these",
    "constant": "less one offset",
    "line": "less a line in the received power",
    "line+network": "the network on what the line leaves",
    "network": "the network alone",
    "chosen (nested)": "of choosing, on what no choice has seen",
}


def show_made(made: Made) -> None:
    from uwb_mitigation.training import cold_start

    if made.choice is not None:
        show_choice(made.choice)
    if made.is_cold:
        console.out.print(
            f"With fewer than {cold_start.ENOUGH_FOR_MEAN} configurations, cold start is kept unless another one is "
            f"{cold_start.MUST_GAIN:.0%} better.",
            highlight=False,
        )
    if "int8" in made.validation.errors:
        show_validation(made.validation)
    show_verdict(made.after_m, made.before_m)
    show_bundle(made.bundle)


def show_choice(choice: Choice) -> None:
    table = Table(
        title=f"{choice.configurations} configurations, {choice.folds} folds by configuration",
        title_justify="left",
    )
    table.add_column("")
    table.add_column("candidate")
    table.add_column("MAE, m", justify="right")
    table.add_column("")
    for row, mae in choice.mae().items():
        is_chosen = row == choice.chosen
        table.add_row(
            "->" if is_chosen else "",
            row,
            f"{mae:.3f}",
            _CANDIDATES.get(row, ""),
            style="bold" if is_chosen else None,
        )
    console.out.print(table)
    curve = ", ".join(f"{mae:.3f} m with {count}" for count, mae in choice.curve)
    needed = choice.needed()
    if not choice.has_outlook:
        outlook = "Too few configurations to say whether more would lower it."
    elif needed is None:
        outlook = "More configurations of this kind are not expected to lower it by 5%."
    else:
        outlook = f"If it goes on like this, some {needed} configurations lower it by 5%."
    console.out.print(f"MAE of {choice.chosen} by configurations: {curve}. {outlook}", highlight=False)


def show_verdict(after_m: float, before_m: Mapping[str, float]) -> None:
    """Whether a MAE on configurations not seen is lower than each of those it is to better, by their names."""
    for name, before in before_m.items():
        change = after_m / before - 1 if before else 0.0
        console.out.print(
            f"on configurations not seen, {after_m:.3f} m against {before:.3f} m {name}: "
            f"{abs(change):.0%} {'lower' if after_m < before else 'higher: this did not help'}",
            highlight=False,
        )


def show_validation(validation: CrossValidation) -> None:
    title = f"{validation.folds}-fold cross-validation by configuration, m"
    table = Table(title=title, min_width=len(title))
    table.add_column("")
    for column in ("MAE", "std", "p95"):
        table.add_column(column, justify="right")
    for row, statistics in validation.statistics().items():
        table.add_row(_ROWS[row], *(f"{value:.3f}" for value in statistics.values()))
    console.out.print(table)


def show_comparison(result: Comparison) -> None:
    labels = list(result.rows[0].by_label)
    table = Table(
        title=f"{result.configurations} configurations, {result.folds} splits by {result.group.value}, "
        f"mean of {result.seeds} seeds, MAE in m"
    )
    table.add_column("")
    for column in ("MAE", "std", "95 % interval", *(label or "no label" for label in labels)):
        table.add_column(column, justify="right")
    for row in result.rows:
        low, high = row.ci95
        table.add_row(
            row.name,
            f"{row.mae_mean:.3f}",
            f"{row.mae_std:.3f}",
            f"{low:.3f}-{high:.3f}",
            *(f"{row.by_label[label]:.3f}" for label in labels),
        )
    console.out.print(table)
    by_label = ", ".join(
        f"{label or 'no label'} {narrow:.0%} and {wide:.0%}"
        for label, (narrow, wide) in result.coverage_by_label.items()
    )
    kept = ", ".join(f"{share:.0%}: {mae:.3f}" for share, mae in result.rejection)
    console.out.print(
        f"shipped_int8: 68 % intervals cover {result.coverage68:.1%}, 95 % intervals {result.coverage95:.1%} "
        f"({by_label})\n"
        f"MAE without the ranges of largest variance, by share rejected: {kept}\n"
        f"passed through as unlike the training data: {result.passed_through:.1%}",
        highlight=False,
        soft_wrap=True,
    )
    if result.universal_coverage is not None:
        covered = ", ".join(
            f"{label or 'all'} {narrow:.1%} and {wide:.1%}"
            for label, (narrow, wide) in result.universal_coverage.items()
        )
        console.out.print(
            f"universal_los_offset: its 68 and 95 % intervals cover {covered}",
            highlight=False,
            soft_wrap=True,
        )


def show_bundle(bundle: Bundle) -> None:
    kind = "int8" if bundle.quantised else "float32"
    console.out.print(
        f"{bundle.path}: {kind}, {len(bundle.model)} bytes, model id {bundle.model_id:08x}",
        markup=False,
        soft_wrap=True,
        highlight=False,
    )


def show_outcome(result: Accuracy) -> None:
    table = Table(title=f"{result.n} ranges, model {result.model_id:08x}, m")
    table.add_column("")
    for column in ("n", "raw MAE", "corrected MAE", "std", "p95"):
        table.add_column(column, justify="right")
    table.add_row(
        "all",
        f"{result.n}",
        f"{result.raw.mae:.3f}",
        f"{result.corrected.mae:.3f}",
        f"{result.corrected.std:.3f}",
        f"{result.corrected.p95:.3f}",
        end_section=True,
    )
    for label, (n, before, after) in result.by_label.items():
        table.add_row(label or "no label", f"{n}", f"{before:.3f}", f"{after:.3f}")
    console.out.print(table)
    for status, count in result.statuses.items():
        if status != "OK":
            console.out.print(f"{status}: {count} ranges passed through as measured", highlight=False)
    if result.trained_on:
        console.out.print(
            f"optimistic: the model was trained on {len(result.trained_on)} of these "
            f"{len(result.by_configuration)} configurations; --cross-validate tells of unseen ones",
            highlight=False,
            soft_wrap=True,
        )
