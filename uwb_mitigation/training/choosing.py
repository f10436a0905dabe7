"""Which model a data set can carry: the simplest of a few that no richer one betters on configurations held out.

What chooses is itself cross-validated: in each outer fold the choice is made anew from the other folds alone, so
that the error that is told of the chosen model was tuned on nothing that it is measured on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.evaluation import lad, splits
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.preference import MUST_GAIN, preferred
from uwb_mitigation.model import floating
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.recipe import Recipe, fit_model, prior_m

ALONE = FitOptions(epochs=20, learning_rate=1e-3, dropout=0.2)
"""How a network without a prior is fitted: it needs more of it than one that only refines a line."""

CURVE_DRAWS = 8
LEAST_POINTS = 3
"""Of a learning curve, to extrapolate it."""

CURVE_SHARES = (0.3, 0.5, 0.75, 1.0)

CONSTANT, LINE, LINE_NETWORK, NETWORK = STANDARD = ("constant", "line", "line+network", "network")

Fitted = tuple[LinePrior, FloatWeights | None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A way to fit a prior and, or not, a network; candidates stand in order of preference, simple before rich.

    Attributes:
        name: in tables.
        fit: from a dataset and a seed.
        trains: it fits a network, which is kept only where choosing it shows a gain on what no choice has seen.
    """

    name: str
    fit: Callable[[Dataset, int], Fitted]
    trains: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What was chosen, and how well that is founded.

    Attributes:
        chosen: name of the candidate.
        errors: {candidate, `raw` or `chosen (nested)`: errors on held-out configurations}, float64 (n,), m.
        curve: (configurations, MAE on others) of the chosen candidate.
        folds, seed: of the outer splits.
        configurations: in all of the data.
    """

    chosen: str
    errors: Mapping[str, NDArray[np.float64]]
    curve: tuple[tuple[int, float], ...]
    folds: int
    seed: int
    configurations: int

    def mae(self) -> dict[str, float]:
        """{name: MAE}, m."""
        return {name: float(np.abs(error).mean()) for name, error in self.errors.items()}

    def as_json(self) -> dict[str, object]:
        """For `train --json`."""
        return {
            "chosen": self.chosen,
            "rows": [{"name": name, "mae": mae} for name, mae in self.mae().items()],
            "learning_curve": [{"configurations": count, "mae": mae} for count, mae in self.curve],
            "configurations_needed": self.needed(),
        }

    @property
    def has_outlook(self) -> bool:
        """Whether the learning curve has points enough for `needed` to say anything."""
        return len(self.curve) >= LEAST_POINTS

    def needed(self, share: float = 0.95) -> int | None:
        """How many configurations it would take for `share` of the error of now; None = more of the same would not do,
        or there is no outlook.

        From MAE = a + b / n, least squares through the learning curve.
        """
        if not self.has_outlook:
            return None
        count, mae = np.array(self.curve, float).T
        (floor, slope), *_ = np.linalg.lstsq(
            np.column_stack([np.ones(len(count)), 1 / count]), mae, rcond=None
        )
        wanted = share * (floor + slope / self.configurations)
        if slope <= 0 or wanted <= floor:
            return None
        return int(np.ceil(slope / (wanted - floor)))


def standard(recipe: Recipe, alone: FitOptions = ALONE) -> list[Candidate]:
    """A constant, a line, a line and a network on what it leaves, a network alone, which is fitted by `alone`."""

    def seeded(of: Recipe, seed: int) -> Recipe:
        return replace(of, fit=replace(of.fit, seed=seed))

    return [
        Candidate(CONSTANT, lambda data, seed: (lad.constant(data.configurations, data.error_m), None)),
        Candidate(LINE, lambda data, seed: (line(data), None)),
        Candidate(
            LINE_NETWORK,
            lambda data, seed: fit_model(data, seeded(recipe_of(LINE_NETWORK, recipe), seed)),
            trains=True,
        ),
        Candidate(
            NETWORK,
            lambda data, seed: fit_model(data, seeded(recipe_of(NETWORK, recipe, alone), seed)),
            trains=True,
        ),
    ]


def line(data: Dataset) -> LinePrior:
    """The line prior (see `lad.fit_prior`)."""
    return lad.fit_prior(data.configurations, data.rx_power_dbm, data.first_path_power_dbm, data.error_m)


def recipe_of(name: str, recipe: Recipe, alone: FitOptions = ALONE) -> Recipe:
    """The recipe of a standard candidate; a network without a line is fitted by `alone`."""
    return replace(
        recipe,
        line=name in (LINE, LINE_NETWORK),
        network=name in (LINE_NETWORK, NETWORK),
        fit=alone if name == NETWORK else recipe.fit,
    )


def choose(
    dataset: Dataset,
    candidates: Sequence[Candidate],
    folds: int,
    seed: int,
    on_fit: Callable[[], None] = lambda: None,
    *,
    must_gain: float = MUST_GAIN,
) -> Choice:
    """Choose by cross-validation over configurations, and tell by a nested one how good the choice is.

    `must_gain`: see `preferred`.

    Raises:
        DatasetError, ParameterError: see `splits.by_configuration` and `fit`.
    """
    names = [candidate.name for candidate in candidates]
    errors = {name: dataset.error_m.copy() for name in ("raw", *names, NESTED)}
    for split in splits.by_configuration(dataset.configurations, folds, seed):
        train, test = dataset.rows(split.train), dataset.rows(split.test)
        left = _left(train, test, candidates, seed, on_fit)
        inner = _held_out(train, candidates, max(2, folds - 2), seed, on_fit)
        for name in names:
            errors[name][split.test] = left[name]
        errors[NESTED][split.test] = left[preferred(inner, must_gain)]
    chosen = preferred({name: errors[name] for name in names}, must_gain)
    if untrained := [item.name for item in candidates if not item.trains]:
        fallback = preferred({name: errors[name] for name in untrained}, must_gain)
        # Of many candidates one always looks good on the folds it was picked by: the nested error tells.
        if preferred({fallback: errors[fallback], chosen: errors[NESTED]}, must_gain) == fallback:
            chosen = fallback
    (candidate,) = (item for item in candidates if item.name == chosen)
    curve = _curve(dataset, candidate, seed, on_fit)
    return Choice(chosen, errors, curve, folds, seed, len(dataset.names))


NESTED = "chosen (nested)"
"""Row of what choosing itself leaves on configurations that neither a fit nor a choice has seen."""


def least_configurations(folds: int) -> int:
    """How many configurations `choose` needs, so that each part that a fold leaves fills the inner folds."""
    return 4 if folds == 2 else 3


def fits(folds: int, configurations: int, candidates: int) -> int:
    """How often `choose` reports a fit, for a progress bar."""
    inner = max(2, folds - 2)
    return folds * candidates * (1 + inner) + len(_sizes(configurations)) * CURVE_DRAWS


def _held_out(
    data: Dataset, candidates: Sequence[Candidate], folds: int, seed: int, on_fit: Callable[[], None]
) -> dict[str, NDArray[np.float64]]:
    errors = {candidate.name: data.error_m.copy() for candidate in candidates}
    for split in splits.by_configuration(data.configurations, folds, seed):
        left = _left(data.rows(split.train), data.rows(split.test), candidates, seed, on_fit)
        for name, error in left.items():
            errors[name][split.test] = error
    return errors


def _left(
    train: Dataset, test: Dataset, candidates: Sequence[Candidate], seed: int, on_fit: Callable[[], None]
) -> dict[str, NDArray[np.float64]]:
    """The errors that each candidate, fitted to `train`, leaves of `test`; as measured where it has none."""
    left = {}
    for candidate in candidates:
        prior, network = candidate.fit(train, seed)
        predicted = prior_m(prior, test).astype(np.float64)
        if network is not None:
            predicted = predicted + floating.predict_m(network, test.inputs)
        left[candidate.name] = test.error_m - np.where(np.isfinite(predicted), predicted, 0.0)
        on_fit()
    return left


def _sizes(configurations: int) -> list[int]:
    """How many configurations the points of a learning curve are fitted to; a fifth are always held out."""
    most = configurations - max(1, configurations // 5)
    return sorted({max(2, round(share * most)) for share in CURVE_SHARES if most >= 2})


def _curve(
    data: Dataset, candidate: Candidate, seed: int, on_fit: Callable[[], None]
) -> tuple[tuple[int, float], ...]:
    names = np.array(data.names)
    sizes = _sizes(len(names))
    if not sizes:
        raise DatasetError(f"{len(names)} configurations have no learning curve", valid="3 or more")
    generator = np.random.default_rng(seed)
    found: dict[int, list[float]] = {size: [] for size in sizes}
    for _ in range(CURVE_DRAWS):
        order = generator.permutation(names)
        # The same configurations are held out for every size, so that the sizes compare.
        test = data.rows(np.isin(data.configurations, order[sizes[-1] :]))
        for size in sizes:
            train = data.rows(np.isin(data.configurations, order[:size]))
            left = _left(train, test, [candidate], seed, on_fit)[candidate.name]
            found[size].append(float(np.abs(left).mean()))
    return tuple((size, float(np.mean(maes))) for size, maes in found.items())
