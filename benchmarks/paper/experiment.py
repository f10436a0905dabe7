"""Run the paper's experiment (section III): all networks and window lengths, several seeds, float and int8."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from benchmarks.paper import published
from benchmarks.paper.data import Parts, fingerprint
from benchmarks.paper.jobs import run_jobs
from benchmarks.paper.results import (
    FORMS,
    RESULTS,
    Baseline,
    ErrorsByCondition,
    ExperimentResults,
    TrainedModel,
)
from uwb_mitigation.errors import DatasetError, ModelError, ParameterError, UwbMitigationError, check_name
from uwb_mitigation.files import write_atomically
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.architecture import Architecture, Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import ModelCard, save_bundle, session_options
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation import baselines
from uwb_mitigation.training.fit import fitting
from uwb_mitigation.training.fit.candidates import fit_line, linear_bias_m
from uwb_mitigation.training.fit.model_card import card_of
from uwb_mitigation.training.fit.options import FitOptions
from uwb_mitigation.training.fit.quantisation import MSE, quantise_network

PAPER = FitOptions(published.EPOCHS, published.LEARNING_RATE, published.BATCH, dropout=0.5, weight_decay=0.0)
"""The paper does not report its dropout rate."""

NETWORKS = ("remnet", "remnet_k5", "mlp")
"""REMNet with k0 = 3 (which the paper's parameter counts require), with k0 = 5 (as its text says), and the baseline."""

JOURNAL = "journal.jsonl"
VARIANCE_FOLDS = 5

CALIBRATIONS: Mapping[str, float | None] = dict(
    zip(("max", "p99.99", "p99.9", "p99", "mse"), (100.0, 99.99, 99.9, 99.0, MSE), strict=True)
)
"""{name: percentile of `quantise_network`} to choose activation scales by."""

CALIBRATION_INPUTS, CHECK_INPUTS = 512, 1024
_BATCH = 1024


@dataclass(frozen=True, slots=True)
class Task:
    """One network to train."""

    network: str
    samples: int
    seed: int

    def __post_init__(self) -> None:
        check_name("network", self.network, NETWORKS)

    @property
    def name(self) -> str:
        """File name of the training."""
        return f"{self.network}_{self.samples}_seed{self.seed}"

    @property
    def architecture(self) -> Architecture:
        """Architecture of the network."""
        if self.network == "mlp":
            return Mlp(self.samples)
        return Remnet(self.samples, first_kernel=5 if self.network == "remnet_k5" else 3)


def list_tasks(networks: Sequence[str], windows: Sequence[int], seeds: int) -> list[Task]:
    """Return the tasks for all window lengths and seeds; for the MLP only the longest window.

    Raises:
        ParameterError: unknown network, or no seeds or windows.
    """
    if seeds < 1 or not windows:
        raise ParameterError(f"{seeds} seeds, {len(windows)} windows", valid="at least 1 of each")
    return [
        Task(network, samples, seed)
        for network in networks
        for samples in ([max(windows)] if network == "mlp" else windows)
        for seed in range(seeds)
    ]


def run_experiment(
    data_split: Parts,
    folder: Path,
    tasks: Sequence[Task],
    options: FitOptions = PAPER,
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda fraction: None,
    command: str = "",
) -> ExperimentResults:
    """Train, optimise, quantise and test every task, and write `protocol.json`.

    Tasks that an earlier run on the same data and options finished are not repeated. Each network becomes three files:
    `NAME_float.onnx`, `NAME_optimised.onnx`, `NAME_int8.onnx`.

    Raises:
        DatasetError: a loss diverges, or the data is not usable.
        UwbMitigationError: a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be created: {error.strerror}", where=str(folder)) from error
    settings = replace(options, seed=0)
    run_fingerprint = fingerprint(
        json.dumps(asdict(settings), sort_keys=True), data_split.train, data_split.test
    )
    trained = run_jobs(
        _Worker(data_split, folder, options),
        {task.name: task for task in tasks},
        folder / JOURNAL,
        run_fingerprint,
        cost=lambda task: task.architecture.multiply_accumulates,
        workers=workers,
        on_progress=on_progress,
    )
    result = ExperimentResults(
        data=data_split.data,
        split=data_split.split,
        command=command,
        train=len(data_split.train),
        test=len(data_split.test),
        options=settings,
        models=tuple(TrainedModel.model_validate(model) for model in trained.values()),
        baselines=baselines_of(data_split.train, data_split.test),
    )
    write_atomically(folder / RESULTS, result.model_dump_json(indent=1) + "\n")
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Worker:
    data_split: Parts
    folder: Path
    options: FitOptions

    def __call__(self, task: Task) -> dict[str, Any]:
        options = replace(self.options, seed=task.seed)
        return train_task(
            task, self.data_split.shorten_windows(task.samples), self.folder, options
        ).model_dump(mode="json")


def train_task(task: Task, data_split: Parts, folder: Path, options: FitOptions) -> TrainedModel:
    """Train one network from random weights to int8, on data with the task's windows; raises as `fit` and `quantise_network`."""
    train, test, architecture = data_split.train, data_split.test, task.architecture
    start = time.perf_counter()
    fields: dict[str, Any] = {}
    weights = fitting.fit(architecture, train.inputs, train.error_m, options)
    training_s = time.perf_counter() - start
    files = {form: folder / f"{task.name}_{form}.onnx" for form in FORMS}
    card = paper_card(task.name, architecture, data_split, options)
    maes, best, integers = calibrate_quantisation(weights, train.inputs, train.error_m, options.seed)
    save_bundle(files["float"], graph.float_model(weights), card)
    # Use only optimisations that do not depend on the processor, so that the file runs on other ones.
    settings = session_options()
    settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    settings.optimized_model_filepath = str(files["optimised"])
    _session(files["float"], settings)
    save_bundle(files["int8"], graph.int8_model(integers), replace(card, quantised=True))
    predicted = {form: _predict_m(files[form], test.inputs, fuse=form == "int8") for form in FORMS}
    fields |= {f"bytes_{form}": path.stat().st_size for form, path in files.items()}
    fields |= {"calibration": best, "calibration_mae": maes}
    errors = {
        form: ErrorsByCondition.of(test.error_m, test.error_m - outputs, test.labels)
        for form, outputs in predicted.items()
    }
    fields |= {f"mae_{form}": condition_errors.all.mae for form, condition_errors in errors.items()}
    return TrainedModel(
        network=task.network,
        samples=task.samples,
        seed=task.seed,
        parameters=architecture.parameters,
        multiply_accumulates=architecture.multiply_accumulates,
        mae_raw=float(np.abs(test.error_m).mean()),
        float_errors=errors["float"],
        int8_errors=errors["int8"],
        seconds=training_s,
        samples_per_s=len(train) * options.epochs / max(training_s, 1e-9),
        **fields,
    )


def calibrate_quantisation(
    weights: FloatWeights, inputs: NDArray[np.float32], targets: NDArray[np.floating], seed: int
) -> tuple[dict[str, float], str, Int8Weights]:
    """Quantise with every one of `CALIBRATIONS` on inputs (n, K) of the training part, and keep the best.

    Returns:
        MAE of each on training inputs that it was not calibrated on, m; the best; its network.

    Raises:
        DatasetError: fewer than two inputs. ModelError: see `quantise_network`.
    """
    if len(inputs) < 2:
        raise DatasetError(f"{len(inputs)} inputs for calibration and check", valid="at least 2")
    order = np.random.default_rng(seed).permutation(len(inputs))
    count = min(CALIBRATION_INPUTS, len(inputs) // 2)
    calibration, check_rows = inputs[order[:count]], order[count : count + CHECK_INPUTS]
    maes = {}
    for name, percentile in CALIBRATIONS.items():
        network = IntegerNetwork(quantise_network(weights, calibration, percentile, exact=False))
        maes[name] = float(np.abs(targets[check_rows] - network.predict_m(inputs[check_rows])).mean())
    best = min(maes, key=lambda name: maes[name])
    return maes, best, quantise_network(weights, calibration, CALIBRATIONS[best])


def _session(path: Path, settings: onnxruntime.SessionOptions) -> onnxruntime.InferenceSession:
    try:
        return onnxruntime.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors have no narrower base class.
        raise ModelError(f"ONNX Runtime rejects the model: {error}", where=str(path)) from error


def _predict_m(path: Path, inputs: NDArray[np.float32], *, fuse: bool) -> NDArray[np.float32]:
    """Return outputs (n,) of an ONNX file; int8 networks need ONNX Runtime's fusion of nodes."""
    settings = session_options()
    if not fuse:
        settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = _session(path, settings)
    name = session.get_inputs()[0].name
    batches_m = [
        session.run(None, {name: inputs[start : start + _BATCH, None, :]})[0][:, 0]
        for start in range(0, len(inputs), _BATCH)
    ]
    return np.concatenate([np.zeros(0, np.float32), *batches_m])


def baselines_of(train: Dataset, test: Dataset) -> tuple[Baseline, ...]:
    """Return the constants and the line in the received power, fitted on `train`, tested on `test`.

    The line does not change a range whose power is unknown.

    Raises:
        DatasetError: no training data.
    """

    def row(name: str, predicted: NDArray[np.floating]) -> Baseline:
        return Baseline(
            name=name, errors=ErrorsByCondition.of(test.error_m, test.error_m - predicted, test.labels)
        )

    medians = {"los_median": baselines.los_median, "overall_median": baselines.overall_median}
    rows = [row(name, fit(train)(test)) for name, fit in medians.items()]
    line, reason = LinearBiasModel(0.0), "the data contains no received powers"
    if all(np.isfinite(part.rx_power_dbm - part.first_path_power_dbm).any() for part in (train, test)):
        line, reason = fit_line(train), "too few configurations, or almost equal powers"
    if not line.needs_power:
        return (*rows, Baseline(name="line", errors=None, reason=reason))
    return (*rows, row("line", np.nan_to_num(linear_bias_m(line, test))))


def paper_card(name: str, architecture: Architecture, data_split: Parts, options: FitOptions) -> ModelCard:
    """Return the card of a float network without a linear bias model that was fitted to the whole training part.

    Its variance comes from a second network, fitted to a fifth of the training configurations and tested on the others.
    That network has less training data, so the variance is conservative. The test part is not used.

    Raises:
        DatasetError: the training part has only one configuration; see also `fit`.
    """
    train = data_split.train
    folds = min(VARIANCE_FOLDS, len(train.names))
    fold = splits.by_configuration(train.configurations, folds, options.seed)[0]
    small_part, other_part = train.rows(fold.test), train.rows(fold.train)
    network = fitting.fit(architecture, small_part.inputs, small_part.error_m, options)
    residual_m = other_part.error_m - floating.predict_m(network, other_part.inputs)
    training = {
        "data": data_split.data,
        "split": data_split.split,
        "seed": options.seed,
        "recipe": asdict(options),
        "measurements": len(train),
        "tested_on": len(data_split.test),
        "variance": f"of a network fitted to 1 of {folds} parts of the training configurations, on the others",
    }
    return card_of(name, architecture, train, LinearBiasModel(0.0), other_part, residual_m, training)
