"""No test data reaches a fit, a calibration or a selection.

All functions that fit to data are observed. Their inputs must not contain a row of a configuration that is held
out at that moment, by the current fold or by the test part of a command.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np
import pytest
from model_material import dataset
from numpy.typing import NDArray
from typer.testing import CliRunner

from benchmarks.cli import app
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.splits import Split
from uwb_mitigation.training.evaluation import baselines
from uwb_mitigation.training.fit import linear_fit

pytest.importorskip("torch", reason="run `make setup-training`")
from benchmarks.paper import data as recordings
from benchmarks.paper import experiment, training
from benchmarks.paper.training import NetworkStack
from uwb_mitigation.training import comparison, train
from uwb_mitigation.training.fit import candidates, fitting, model_card, selection
from uwb_mitigation.training.fit.candidates import Recipe
from uwb_mitigation.training.fit.options import FitOptions

SAMPLES = 8
QUICK = FitOptions(epochs=1)
RECIPE = Recipe(Remnet(SAMPLES, modules=1, filters=4), QUICK, QUICK)

LEARNERS = {
    comparison: "fit calibration_inputs quantise_network",
    fitting: "fit",
    candidates: "fit_new_model",
    train: "fit_new_model fit_with_card calibration_inputs quantise_network site_card",
    linear_fit: "fit_linear_bias fit_constant",
    baselines: "los_median overall_median ridge gradient_boosting",
    model_card: "fit_intervals",
    experiment: "card_of quantise_network",
    NetworkStack: "fit",
}
"""Functions that fit to data."""


class Watch:
    """Held-out configurations, and inputs of each learner.

    Attributes:
        seen: configurations in the last call of each learner.
        held_out: configurations of the current folds and of the test part.
    """

    def __init__(self, data: Dataset) -> None:
        self.seen: dict[str, set[str]] = {}
        self.held_out: list[set[str]] = []
        rows = zip(data.inputs, data.configurations.tolist(), strict=True)
        self._of = {row.tobytes(): name for row, name in rows}
        assert len(self._of) == len(data), "identical rows cannot be distinguished"

    def called(self, *names: str) -> None:
        """Check that each of these learners was called at least once."""
        assert not set(names) - self.seen.keys()

    @contextmanager
    def without(self, names: Iterable[str]) -> Iterator[None]:
        self.held_out.append(set(names))
        yield
        self.held_out.pop()

    def folds(self, found: list[Split], names: NDArray[np.str_]) -> list[Split]:
        """Yield the same splits; each is held out during its iteration."""
        watch = self

        class Folds(list):  # type: ignore[type-arg]
            def __iter__(self) -> Iterator[Split]:
                for split in super().__iter__():
                    with watch.without(names[split.test].tolist()):
                        yield split

        return Folds(found)

    def learner(self, name: str, learn: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(learn)
        def watched(*arguments: Any, **options: Any) -> Any:
            seen = set().union(*(self.names_in(value) for value in (*arguments, *options.values())))
            self.seen[name] = seen
            assert seen, f"{name} got nothing whose configuration is known"
            for held_out in self.held_out:
                assert not seen & held_out, f"{name} got {sorted(seen & held_out)}, which are held out"
            return learn(*arguments, **options)

        return watched

    def names_in(self, value: Any) -> set[str]:
        """Return the configurations of an argument of a learner."""
        if isinstance(value, train.CrossValidation):
            value = value.dataset
        if isinstance(value, Dataset):
            return set(value.configurations.tolist())
        if isinstance(value, np.ndarray) and value.dtype.kind == "U":
            return set(value.tolist())
        if isinstance(value, np.ndarray) and value.ndim == 2:
            return {self._of[row.tobytes()] for row in value}
        return set()


@pytest.fixture(scope="module")
def data() -> Dataset:
    """Return placements in five rooms with the names of DeepUWB, whose splits test in the medium room."""
    plain = dataset(15, 6, samples=SAMPLES)
    rooms = {f"c{n}": f"simulated seed 1/deepuwb/room{n % 5}/clear/placement {n}" for n in range(15)}
    return replace(plain, configurations=np.array([rooms[name] for name in plain.configurations]))


@pytest.fixture
def watch(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> Watch:
    watch = Watch(data)
    for module, name in ((module, name) for module, names in LEARNERS.items() for name in names.split()):
        watched = watch.learner(f"{module.__name__.split('.')[-1]}.{name}", getattr(module, name))
        monkeypatch.setattr(module, name, watched)
    divide = splits.by_configuration

    def by_configuration(names: NDArray[np.str_], folds: int, seed: int) -> list[Split]:
        return watch.folds(divide(names, folds, seed), names)

    monkeypatch.setattr(splits, "by_configuration", by_configuration)
    monkeypatch.setattr(candidates, "NETWORK_ONLY", QUICK)
    return watch


def test_no_row_of_the_comparison_was_fitted_on_its_test_data(data, watch):
    comparison.compare_models(data, RECIPE, folds=2, seeds=1)
    watch.called(*(f"baselines.{name}" for name in LEARNERS[baselines].split()))
    watch.called("train.fit_with_card", "linear_fit.fit_linear_bias", "model_card.fit_intervals")
    watch.called("comparison.fit", "comparison.calibration_inputs", "comparison.quantise_network")


def test_cross_validation_fits_and_calibrates_without_the_fold(data, watch):
    found = train.cross_validate(data, RECIPE, 3, 0)
    watch.called("fitting.fit", "linear_fit.fit_linear_bias")
    watch.called("train.calibration_inputs", "train.quantise_network")
    for split in splits.by_configuration(data.configurations, 3, 0):
        expected = data.error_m[split.test] - np.median(data.error_m[split.train])
        assert np.allclose(found.errors["overall_median"][split.test], expected)


def test_error_of_a_selection_is_from_folds_that_were_not_used_in_it(data, watch, monkeypatch):
    prefer = selection.select_simplest
    nested = []

    def select_simplest(errors: dict[str, NDArray[np.float64]], min_gain: float) -> str:
        if watch.held_out:
            held_out = set().union(*watch.held_out)
            nested.append({len(error) for error in errors.values()})
            assert nested[-1] == {int((~np.isin(data.configurations, list(held_out))).sum())}
        return prefer(errors, min_gain)

    monkeypatch.setattr(selection, "select_simplest", select_simplest)
    own = candidates.new_models(RECIPE)
    selection.select_nested(data, [own[0], own[2]], 3, 0)
    assert nested
    watch.called("linear_fit.fit_constant", "fitting.fit")


def test_command_trains_on_the_training_part(data, watch, monkeypatch, tmp_path):
    words = f"paper protocol --data x -o {tmp_path} --networks remnet,mlp --windows {SAMPLES} --seeds 1"
    monkeypatch.setattr(training, "RANGE_TEST_RATES", np.geomspace(1e-6, 1.0, 120))
    monkeypatch.setattr(recordings, "load_paper_data", lambda *_, **__: ("made up", True, data))
    with watch.without(name for name in data.names if "room2" in name):
        options = "--epochs 1 --trials 1 --workers 1"
        CliRunner().invoke(app, f"{words} {options}".split(), catch_exceptions=False)
    watch.called("NetworkStack.fit", "experiment.quantise_network", "experiment.card_of")
    watch.called("baselines.overall_median")
