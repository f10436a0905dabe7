"""The paper's experiment (section III): every network and window length, several seeds, float to int8.

`run` trains what is not yet in its folder, one file of results a network, so that an interrupted run goes on where
it stopped. `evaluation.results` has their form, and gives them to a report.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from uwb_mitigation.dataset import Dataset
from uwb_mitigation.errors import DatasetError, ParameterError, UwbMitigationError
from uwb_mitigation.evaluation import baselines, lad, paper, splits
from uwb_mitigation.evaluation.results import (
    RESULTS,
    Baseline,
    ErrorsByCondition,
    ExperimentResults,
    PartErrors,
    Settings,
    TrainedModel,
)
from uwb_mitigation.files import write_whole
from uwb_mitigation.model import floating, graph
from uwb_mitigation.model.architecture import Architecture, Mlp, Remnet
from uwb_mitigation.model.bundle import Card, save_bundle
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import calibration, fitting, networks, parallel
from uwb_mitigation.training.cards import card_of
from uwb_mitigation.training.optimisation import optimise_file, predict_file_m
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.parts import Parts, divided

PAPER = FitOptions(paper.EPOCHS, paper.LEARNING_RATE, paper.BATCH, dropout=0.5, weight_decay=0.0)
"""The paper does not give its dropout."""

NETWORKS = ("remnet", "remnet_k5", "remnet_attention", "mlp")
"""REMNet with k0 = 3, which the paper's counts of parameters need; with k0 = 5, which its text says; with the
attention of the original, in float alone; and the baseline."""

QUICK_EPOCHS = 2
QUICK_MEASUREMENTS = 5000

VARIANCE_FOLDS = 5
LOS = "LOS"


@dataclass(frozen=True, slots=True)
class Task:
    """One network to train."""

    network: str
    samples: int
    seed: int

    def __post_init__(self) -> None:
        if self.network not in NETWORKS:
            raise ParameterError(f"network {self.network!r}", valid=", ".join(NETWORKS))

    @property
    def name(self) -> str:
        return f"{self.network}_{self.samples}_seed{self.seed}"

    @property
    def architecture(self) -> Architecture:
        if self.network == "mlp":
            return Mlp(self.samples)
        return Remnet(self.samples, first_kernel=5 if self.network == "remnet_k5" else 3)


def tasks(networks_: Sequence[str], windows: Sequence[int], seeds: int) -> list[Task]:
    """Every network at every window length and seed; the MLP and the attention at the longest window alone.

    Raises:
        ParameterError: a network is unknown, or there are no seeds or windows.
    """
    if seeds < 1 or not windows:
        raise ParameterError(f"{seeds} seeds, {len(windows)} windows", valid="1 or more of each")
    return [
        Task(network, samples, seed)
        for network in networks_
        for samples in (windows if network in ("remnet", "remnet_k5") else [max(windows)])
        for seed in range(seeds)
    ]


def run(
    parts: Parts,
    folder: Path,
    wanted: Sequence[Task],
    options: FitOptions = PAPER,
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda share: None,
) -> ExperimentResults:
    """Train, optimise, quantise and test every task, and write `protocol.json`.

    A task whose result is in `folder` already, from the same data and options, is not done again. Bundles are
    written beside the results: `NAME_float.onnx`, `NAME_optimised.onnx`, `NAME_int8.onnx`.

    Args:
        workers: processes, each of one thread.
        on_progress: called with the share of the work that is done, 0 to 1.

    Raises:
        DatasetError: a loss diverges, or the data cannot be fitted to.
        UwbMitigationError: a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be made: {error.strerror}", where=str(folder)) from error
    mark = _fingerprint(parts, options)
    missing = [task for task in wanted if _stored(folder, task, mark) is None]
    total = sum(_work(task) for task in wanted) or 1.0
    done = total - sum(_work(task) for task in missing)
    on_progress(done / total)
    # The longest first: the last to finish is then a short one.
    missing.sort(key=_work, reverse=True)
    parallel.each(
        _Worker(parts, folder, options, mark),
        missing,
        workers,
        lambda amount: on_progress(min((done + amount) / total, 1.0)),
    )
    models = tuple(model for task in wanted if (model := _stored(folder, task, mark)) is not None)
    result = ExperimentResults(
        data=parts.data,
        split=parts.split,
        train=len(parts.train),
        test=len(parts.test),
        options=Settings(**asdict(options)),
        models=models,
        baselines=baselines_of(parts.train, parts.test),
    )
    write_whole(folder / RESULTS, result.model_dump_json(indent=1) + "\n")
    return result


def run_quick(
    name: str, dataset: Dataset, folder: Path, on_progress: Callable[[float], None] = lambda share: None
) -> ExperimentResults:
    """Every network of the paper in short, to see that everything works; raises as `run` and `divided`.

    One seed and `QUICK_EPOCHS`, on at most `QUICK_MEASUREMENTS`.
    """
    parts = divided(name, dataset, splits.AUTO)
    # Evenly over the data, whose rows are in the order of places.
    step = -(-len(parts.train) // QUICK_MEASUREMENTS)
    if step > 1:
        thinned = parts.train.rows(np.arange(0, len(parts.train), step))
        parts = replace(parts, split=f"{parts.split}; one in {step} of those to train on", train=thinned)
    wanted = tasks(["remnet", "mlp"], paper.WINDOWS, seeds=1)
    return run(parts, folder, wanted, replace(PAPER, epochs=QUICK_EPOCHS), on_progress=on_progress)


@dataclass(frozen=True, slots=True, eq=False)
class _Worker:
    """Does one task; sent to each process once."""

    parts: Parts
    folder: Path
    options: FitOptions
    mark: int

    def __call__(self, task: Task, advance: Callable[[float], None]) -> None:
        parts = self.parts.narrowed(task.samples)
        step = _work(task) / self.options.epochs
        options = replace(self.options, seed=task.seed)
        model = train_task(task, parts, self.folder, options, lambda: advance(step))
        stored = _Stored(fingerprint=self.mark, model=model)
        write_whole(self.folder / f"{task.name}.json", stored.model_dump_json(indent=1) + "\n")


def train_task(
    task: Task,
    parts: Parts,
    folder: Path,
    options: FitOptions,
    on_epoch: Callable[[], None] = lambda: None,
) -> TrainedModel:
    """One network, from fresh weights to int8, on parts with the task's windows; its files go to `folder`.

    Raises:
        DatasetError, ModelError: as `fit` and `quantize`.
    """
    start = time.perf_counter()
    architecture, train = task.architecture, parts.train
    if task.network == "remnet_attention" and isinstance(architecture, Remnet):
        parameters, predicted = _fit_attention(architecture, train, parts.test, options, on_epoch)
        seconds = time.perf_counter() - start
        return _result(task, parameters, parts, predicted, seconds, options)
    weights = fitting.fit(architecture, train.inputs, train.error_m, options, on_epoch)
    seconds = time.perf_counter() - start
    return _exported(task, weights, parts, folder, options, seconds)


def _fit_attention(
    architecture: Remnet,
    train: Dataset,
    test: Dataset,
    options: FitOptions,
    on_epoch: Callable[[], None],
) -> tuple[int, NDArray[np.float32]]:
    """Count of parameters and outputs on the test part, (n,)."""
    with fitting.single_thread(options.seed):
        module = networks.RemnetModule(architecture, options.dropout, attention=True)
        fitting.descend(module, train.inputs, train.error_m, options, on_epoch)
        predicted = fitting.predict_m(module, test.inputs)
    return sum(values.numel() for values in module.parameters()), predicted


def _exported(
    task: Task,
    weights: FloatWeights,
    parts: Parts,
    folder: Path,
    options: FitOptions,
    seconds: float,
) -> TrainedModel:
    train, test = parts.train, parts.test
    paths = {kind: folder / f"{task.name}_{kind}.onnx" for kind in ("float", "optimised", "int8")}
    compared = calibration.compare(weights, train.inputs, train.error_m, options.seed)
    card = describe(task.name, weights.architecture, parts, options)
    save_bundle(paths["float"], graph.float_model(weights), card)
    optimise_file(paths["float"], paths["optimised"])
    save_bundle(paths["int8"], graph.int8_model(compared.network), replace(card, quantised=True))
    predicted = {
        kind: predict_file_m(path, test.inputs, as_it_is=kind != "int8") for kind, path in paths.items()
    }
    size = {kind: path.stat().st_size for kind, path in paths.items()}
    mae = {kind: float(np.abs(test.error_m - values).mean()) for kind, values in predicted.items()}
    result = _result(task, weights.architecture.parameters, parts, predicted["float"], seconds, options)
    return result.model_copy(
        update={
            "mae_optimised": mae["optimised"],
            "mae_int8": mae["int8"],
            "bytes_float": size["float"],
            "bytes_optimised": size["optimised"],
            "bytes_int8": size["int8"],
            "int8_errors": _by_part(test, predicted["int8"]),
            "calibration": compared.best,
            "calibration_mae": dict(compared.mae_m),
        }
    )


def _result(
    task: Task,
    parameters: int,
    parts: Parts,
    predicted: NDArray[np.float32],
    seconds: float,
    options: FitOptions,
) -> TrainedModel:
    errors = _by_part(parts.test, predicted)
    raw, left = errors.all.mae_raw, errors.all.mae
    if raw is None or left is None:
        raise DatasetError("the test part is empty", valid="one measurement or more")
    return TrainedModel(
        network=task.network,
        samples=task.samples,
        seed=task.seed,
        parameters=parameters,
        multiply_accumulates=task.architecture.multiply_accumulates,
        mae_raw=raw,
        mae_float=left,
        mae_optimised=None,
        mae_int8=None,
        bytes_float=None,
        bytes_optimised=None,
        bytes_int8=None,
        float_errors=errors,
        int8_errors=None,
        calibration=None,
        calibration_mae=None,
        seconds=seconds,
        samples_per_s=len(parts.train) * options.epochs / max(seconds, 1e-9),
    )


def baselines_of(train: Dataset, test: Dataset) -> tuple[Baseline, ...]:
    """What the networks have to beat: constants, and the line in the radio's levels, fitted on `train`.

    A range whose level is unknown has no line, and counts as it was measured.

    Raises:
        DatasetError: there is nothing to train on.
    """
    constants = {"los_median": baselines.los_median, "overall_median": baselines.overall_median}
    rows = [Baseline(name=name, errors=_by_part(test, fit(train)(test))) for name, fit in constants.items()]
    if not all(np.isfinite(part.rx_power_dbm - part.first_path_power_dbm).any() for part in (train, test)):
        return (*rows, Baseline(name="line", errors=None, reason="the data has no received power"))
    line = lad.fit_prior(train.configurations, train.rx_power_dbm, train.first_path_power_dbm, train.error_m)
    if not line.needs_power:
        return (
            *rows,
            Baseline(name="line", errors=None, reason="too few configurations, or powers that are all alike"),
        )
    predicted = line.predict_batch_m(test.rx_power_dbm, test.first_path_power_dbm)
    return (*rows, Baseline(name="line", errors=_by_part(test, np.nan_to_num(predicted))))


def _by_part(test: Dataset, predicted: NDArray[np.floating]) -> ErrorsByCondition:
    left, los = test.error_m - predicted, test.labels == LOS
    chosen = {"all": np.ones(len(test), np.bool_), "los": los, "nlos": ~los & (test.labels != "")}
    return ErrorsByCondition(
        **{name: PartErrors.of(test.error_m[rows], left[rows]) for name, rows in chosen.items()}
    )


def describe(name: str, architecture: Architecture, parts: Parts, options: FitOptions) -> Card:
    """The card of a float network without a prior that was fitted to the training part.

    Nothing of it comes from the errors of the test part. All of the training part is fitted to, so that none of it
    can tell what is left on other placements: the variance of corrected ranges is that of another such network,
    fitted to a fifth of the training part's configurations, on the other four. With less to learn from, that
    network errs more; the variance errs on the safe side.

    Raises:
        DatasetError: the training part has one configuration alone; see also `fit`.
    """
    train = parts.train
    folds = min(VARIANCE_FOLDS, len(train.names))
    fold = splits.by_configuration(train.configurations, folds, options.seed)[0]
    seen, unseen = train.rows(fold.test), train.rows(fold.train)
    network = fitting.fit(architecture, seen.inputs, seen.error_m, options)
    left = unseen.error_m - floating.predict_m(network, unseen.inputs)
    training = {
        "data": parts.data,
        "split": parts.split,
        "seed": options.seed,
        "recipe": asdict(options),
        "measurements": len(train),
        "tested_on": len(parts.test),
        "variance": f"of a network fitted to 1 of {folds} parts of the training configurations, on the others",
    }
    return card_of(name, architecture, train, LinePrior(0.0), unseen, left, training)


def _work(task: Task) -> float:
    """In proportion to the time of training, roughly."""
    return task.architecture.multiply_accumulates * (2.5 if task.network == "remnet_attention" else 1.0)


def _fingerprint(parts: Parts, options: FitOptions) -> int:
    """Differs where data or options differ."""
    mark = zlib.crc32(json.dumps(asdict(replace(options, seed=0)), sort_keys=True).encode())
    for part in (parts.train, parts.test):
        for array in (part.inputs, part.error_m):
            mark = zlib.crc32(array.tobytes(), mark)
    return mark


class _Stored(BaseModel):
    """The result of one task, and what it was made of."""

    fingerprint: int
    model: TrainedModel


def _stored(folder: Path, task: Task, mark: int) -> TrainedModel | None:
    """The result of an earlier run; None where there is none, or not of this data."""
    try:
        stored = _Stored.model_validate_json((folder / f"{task.name}.json").read_bytes())
    except (OSError, ValueError):
        return None
    return stored.model if stored.fingerprint == mark else None
