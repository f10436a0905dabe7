"""From labelled measurements to a float bundle: choose, fit to all of the data, write; what `train` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.preference import MUST_GAIN
from uwb_mitigation.model import graph
from uwb_mitigation.model.bundle import Bundle, load_bundle, save_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.training import adaptation, choosing, cold_start
from uwb_mitigation.training import recipe as recipes
from uwb_mitigation.training.choosing import Candidate, Choice
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.recipe import CrossValidation, Recipe

AUTO = "auto"

Progress = Callable[[str, float], None]
"""Is told what is being done, and the share of it that is, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """A bundle that was written, and how good it is on configurations that were held out.

    Attributes:
        choice: None where the recipe was given.
        validation: what the card's intervals are from.
        after_m: MAE of the model, m; where there was a choice, of choosing it anew each time.
        before_m: {name: MAE of what it is to better}, m.
    """

    bundle: Bundle
    choice: Choice | None
    validation: CrossValidation
    after_m: float
    before_m: dict[str, float]

    @property
    def helped(self) -> bool:
        return self.after_m < min(self.before_m.values())

    def as_json(self) -> dict[str, object]:
        """The result of `uwb-mitigation train`."""
        tested = "int8" if "int8" in self.validation.errors else "float"
        dataset = self.validation.dataset
        groups = self.validation.by_configuration(tested).items()
        return {
            "model_id": self.bundle.model_id,
            "n": len(dataset),
            "refused": dict(dataset.refused),
            "helped": self.helped,
            "rows": [{"name": row, **values} for row, values in self.validation.statistics().items()],
            "by_configuration": {
                key: {"n": n, "raw_mae": before, "corrected_mae": after} for key, (n, before, after) in groups
            },
            **({} if self.choice is None else {"choice": self.choice.as_json()}),
        }

    @property
    def is_cold(self) -> bool:
        """Whether the cold start was preferred."""
        chosen_from = {} if self.choice is None else self.choice.errors
        return cold_start.NAME in chosen_from and cold_start.is_few(self.validation.dataset)


def of_recipe(
    dataset: Dataset,
    name: str,
    recipe: Recipe,
    alone: FitOptions,
    chosen: str,
    output: Path,
    folds: int,
    on_progress: Progress,
) -> Made:
    """A model of one's own by `recipe`: the candidate `chosen` of `choosing.STANDARD`, or AUTO for the best of them.

    AUTO also offers what was trained in simulated buildings (`cold_start`).

    Args:
        name: of the data, for the card.
        alone: how a network without a line is fitted.

    Raises:
        ParameterError: there is no such candidate.
        DatasetError: there are too few configurations; see also `fit`.
    """
    if chosen not in (AUTO, *choosing.STANDARD):
        raise ParameterError(f"recipe {chosen!r}", valid=", ".join((AUTO, *choosing.STANDARD)))
    _check_configurations(dataset, choosing.least_configurations(folds) if chosen == AUTO else 2)
    folds, seed = min(folds, len(dataset.names)), recipe.fit.seed
    choice = None
    if chosen == AUTO:
        start = load_bundle(default_model_path(dataset.preprocessing.scaling))
        candidates = cold_start.offered(choosing.standard(recipe, alone), dataset, start)
        choice = _choose(dataset, candidates, folds, seed, on_progress)
        chosen = choice.chosen
    if choice is not None and chosen in cold_start.NAMES:
        return _chosen(dataset, name, choice, candidates, start, recipe.fit, output, ("raw",))
    recipe = choosing.recipe_of(chosen, recipe, alone)
    total, done = recipe.fit.epochs * (folds + 1), 0

    def on_epoch() -> None:
        nonlocal done
        done += 1
        on_progress("training", done / total)

    validation = recipes.cross_validate(dataset, recipe, folds, seed, on_epoch)
    line, network = recipes.fit_model(dataset, recipe, on_epoch)
    card = recipes.describe(output.stem, recipe, line, validation, name)
    mae = {row: statistics["mae"] for row, statistics in validation.statistics().items()}
    after = mae["int8"] if choice is None else choice.mae()[choosing.NESTED]
    bundle = save_bundle(output, graph.float_model(network), card)
    return Made(bundle, choice, validation, after, {"raw": mae["raw"]})


def of_another(
    dataset: Dataset,
    name: str,
    source: Bundle,
    options: FitOptions,
    output: Path,
    folds: int,
    on_progress: Progress,
    *,
    offer_cold_start: bool,
) -> Made:
    """A model that starts from `source`; `offer_cold_start`: and from the one that was trained in simulated buildings.

    Raises:
        DatasetError: there are too few configurations; see also `fit`.
        ModelError: the source's network is no REMNet.
    """
    _check_configurations(dataset, choosing.least_configurations(folds))
    candidates = adaptation.candidates(source, options)
    simulated = load_bundle(default_model_path(dataset.preprocessing.scaling))
    if offer_cold_start:
        # Without a model that is named, the source is that same one: with another offset it is the cold start.
        candidates = [item for item in candidates if item.name != adaptation.OWN_OFFSET]
        candidates = cold_start.offered(candidates, dataset, simulated)
    choice = _choose(dataset, candidates, min(folds, len(dataset.names)), options.seed, on_progress)
    start = simulated if choice.chosen in cold_start.NAMES else source
    before = ("raw", adaptation.AS_SHIPPED)
    return _chosen(dataset, name, choice, candidates, start, options, output, before)


def _chosen(
    dataset: Dataset,
    name: str,
    choice: Choice,
    candidates: Sequence[Candidate],
    start: Bundle,
    options: FitOptions,
    output: Path,
    before: Sequence[str],
) -> Made:
    graded, validation = adaptation.fit_chosen(dataset, choice, candidates, start, options, output.stem, name)
    bundle = save_bundle(output, graph.float_model(graded.network), graded.card)
    mae = choice.mae()
    return Made(bundle, choice, validation, mae[choosing.NESTED], {row: mae[row] for row in before})


def _choose(
    dataset: Dataset, candidates: Sequence[Candidate], folds: int, seed: int, on_progress: Progress
) -> Choice:
    is_cold = candidates[0].name == cold_start.NAME
    total, done = choosing.fits(folds, len(dataset.names), len(candidates)), 0

    def on_fit() -> None:
        nonlocal done
        done += 1
        on_progress("choosing", done / total)

    must_gain = cold_start.MUST_GAIN if is_cold else MUST_GAIN
    return choosing.choose(dataset, candidates, folds, seed, on_fit, must_gain=must_gain)


def _check_configurations(dataset: Dataset, needed: int) -> None:
    """Refuse before any fold is drawn what has too few of them."""
    if (count := len(dataset.names)) < needed:
        raise DatasetError(
            f"{count} configuration{'' if count == 1 else 's'}, that is placements of tag and anchor",
            valid=f"{needed} or more, each under a name of its own in `configuration` of the true ranges",
        )
