"""Run the paper's experiment (section III): all networks and window lengths, several seeds, float and int8."""

from __future__ import annotations

import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import joblib  # type: ignore[import-untyped]
import numpy as np
import onnxruntime
from joblib.externals.loky.process_executor import BrokenProcessPool  # type: ignore[import-untyped]
from numpy.typing import NDArray

from benchmarks.paper import published
from benchmarks.paper.data import Parts
from benchmarks.paper.results import FORMS, RESULTS, ErrorsByCondition, ExperimentResults, TrainedModel
from benchmarks.paper.search import multiply_accumulates, search
from benchmarks.paper.training import NetworkStack, range_test
from uwb_mitigation.errors import ModelError, ParameterError, UwbMitigationError, check_name
from uwb_mitigation.files import write_atomically
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Architecture, Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import save_bundle, session_options
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.training.evaluation import baselines
from uwb_mitigation.training.fit.model_card import card_of
from uwb_mitigation.training.fit.options import FitOptions
from uwb_mitigation.training.fit.quantisation import quantise_network

# On a busy machine, joblib warns that it takes long to write down the arguments of a job.
warnings.filterwarnings("ignore", "Persisting input arguments", UserWarning)

PAPER = FitOptions(published.EPOCHS, published.LEARNING_RATE, published.BATCH, dropout=0.5, weight_decay=0.0)
"""The paper does not report its dropout rate."""

NETWORKS = ("remnet", "remnet_k5", "remnet_attention", "mlp")
"""REMNet with k0 = 3 (which the paper's parameter counts require), with k0 = 5 (as its text says), with the self-attention of
the original network, which the paper removes, and the baseline."""

PRUNED_SHARES, PRUNED_EPOCHS = (0.25, 0.5, 0.75), 2
"""Shares of the weights of REMNet that are removed one after the other, each followed by training of the remaining ones."""

CALIBRATION_INPUTS = 512
_BATCH = 1024


@dataclass(frozen=True, slots=True)
class Task:
    """Networks of one kind to train, one for each seed, and whether to prune them afterwards."""

    network: str
    samples: int
    seeds: int
    prune: bool = False

    def __post_init__(self) -> None:
        check_name("network", self.network, NETWORKS)

    @property
    def architecture(self) -> Architecture:
        """Architecture of the network, without self-attention."""
        if self.network == "mlp":
            return Mlp(self.samples)
        return Remnet(self.samples, first_kernel=5 if self.network == "remnet_k5" else 3)


def list_tasks(networks: Sequence[str], windows: Sequence[int], seeds: int) -> list[Task]:
    """Return the tasks: all window lengths for REMNet, all except that of Fig. 5 only for k0 = 5, otherwise the longest.

    Raises:
        ParameterError: unknown network, or no seeds or windows.
    """
    if seeds < 1 or not windows:
        raise ParameterError(f"{seeds} seeds, {len(windows)} windows", valid="at least 1 of each")
    longest = max(windows)
    in_table = [samples for samples in windows if samples != min(published.WINDOWS)]
    chosen = {"remnet": windows, "remnet_k5": in_table}
    return [
        Task(network, samples, seeds, prune=(network, samples) == ("remnet", longest))
        for network in networks
        for samples in chosen.get(network, [longest])
    ]


def run_experiment(
    data_split: Parts,
    folder: Path,
    tasks: Sequence[Task],
    options: FitOptions = PAPER,
    trials: int = 0,
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda fraction: None,
    command: str = "",
) -> ExperimentResults:
    """Run range test and search (unless `trials` is 0) and all tasks, and write `protocol.json`.

    What an earlier run on the same data and options finished is not repeated. Each network becomes three files:
    `NAME_float.onnx`, `NAME_optimised.onnx`, `NAME_int8.onnx`.

    Raises:
        DatasetError: a loss diverges, or the data is not usable.
        UwbMitigationError: a file cannot be written, or a process was killed.
    """
    longest = data_split.shorten_windows(max(task.samples for task in tasks)).train
    # The most expensive jobs first, so that all processes end at about the same time.
    ordered = sorted(tasks, key=lambda task: -multiply_accumulates(task.architecture))
    jobs: list[tuple[Callable[..., Any], tuple[Any, ...]]] = [
        (train_task, (task, data_split.shorten_windows(task.samples), folder, options)) for task in ordered
    ]
    if trials:
        jobs += [(search, (longest, trials, options)), (range_test, (longest, options, published.SEEDS))]
    results = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        cache = joblib.Memory(folder / "finished", verbose=0).cache
        # Without memory maps: arguments that are mapped have other hashes than those of a run with one process.
        pool = joblib.Parallel(workers, return_as="generator", pre_dispatch="all", max_nbytes=None)
        for result in pool(joblib.delayed(cache(function))(*arguments) for function, arguments in jobs):
            results.append(result)
            on_progress(len(results) / len(jobs))
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(folder)) from error
    except BrokenProcessPool as error:
        raise UwbMitigationError(
            "a training process was killed", valid="fewer workers, or more memory"
        ) from error
    models, test = dict(zip(ordered, results, strict=False)), data_split.test
    median = baselines.overall_median(data_split.train)
    result = ExperimentResults(
        data=data_split.data,
        split=data_split.split,
        command=command,
        train=len(data_split.train),
        test=len(test),
        options=options,
        models=tuple(model for task in tasks for model in models[task]),
        median=ErrorsByCondition.of(test.error_m, test.error_m - median, test.labels),
        trials=results[len(tasks)] if trials else (),
        range_test=results[-1] if trials else None,
    )
    write_atomically(folder / RESULTS, result.model_dump_json(indent=1) + "\n")
    return result


def train_task(task: Task, data_split: Parts, folder: Path, options: FitOptions) -> list[TrainedModel]:
    """Train the networks of a task from random weights to int8, on data with its windows.

    Raises:
        DatasetError: a loss diverges. ModelError: see `quantise_network`.
    """
    train = data_split.train
    attention = task.network == "remnet_attention"
    stack = NetworkStack(task.architecture, task.seeds, options.dropout, attention=attention)
    parameters = sum(values.numel() for values in stack.parameters()) // task.seeds
    start = time.process_time()
    stack.fit(train, options)
    seconds = (time.process_time() - start) / task.seeds

    def measured(network: str, parameters: int) -> Iterator[TrainedModel]:
        for seed in range(task.seeds):
            name = f"{network}_{task.samples}_seed{seed}"
            errors, sizes = _measure(stack, seed, name, data_split, folder, options)
            yield TrainedModel(
                network=network,
                samples=task.samples,
                seed=seed,
                parameters=parameters,
                errors=errors,
                bytes=sizes,
                seconds=seconds,
            )

    models = list(measured(task.network, parameters))
    for share in PRUNED_SHARES if task.prune else ():
        stack.mask_smallest(share)
        stack.fit(train, replace(options, epochs=PRUNED_EPOCHS))
        removed = stack.fix_pruned()
        models += measured(f"remnet_pruned_{100 * share:.0f}", parameters - removed)
    return models


def _measure(
    stack: NetworkStack, seed: int, name: str, data_split: Parts, folder: Path, options: FitOptions
) -> tuple[dict[str, ErrorsByCondition], dict[str, int]]:
    """Return errors and sizes of all forms of a network and write their files; with self-attention, there is only float."""
    train, test = data_split.train, data_split.test
    if stack.attention:
        predicted, sizes = {"float": stack.predict_m(test.inputs)[seed]}, {}
    else:
        weights = stack.weights_of(seed)
        files = {form: folder / f"{name}_{form}.onnx" for form in FORMS}
        details = {
            "data": data_split.data,
            "split": data_split.split,
            "recipe": asdict(options),
            "measurements": len(train),
            "tested_on": len(test),
            "variance": "of the raw ranges: an upper limit",
        }
        # The variance of corrected ranges would need another network that is fitted to a part of the training data.
        card = card_of(name, stack.architecture, train, LinearBiasModel(0.0), train, train.error_m, details)
        save_bundle(files["float"], graph.float_model(weights), card)
        # Use only optimisations that do not depend on the processor, so that the file runs on other ones.
        settings = session_options()
        settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
        settings.optimized_model_filepath = str(files["optimised"])
        _session(files["float"], settings)
        rows = np.random.default_rng(options.seed).permutation(len(train))[:CALIBRATION_INPUTS]
        integers = quantise_network(weights, train.inputs[rows])
        save_bundle(files["int8"], graph.int8_model(integers), replace(card, quantised=True))
        predicted = {form: _predict_m(files[form], test.inputs, fuse=form == "int8") for form in FORMS}
        sizes = {form: path.stat().st_size for form, path in files.items()}
        sizes["zipped"] = len(zlib.compress(files["int8"].read_bytes(), 9))
    errors = {
        form: ErrorsByCondition.of(test.error_m, test.error_m - outputs, test.labels)
        for form, outputs in predicted.items()
    }
    return errors, sizes


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
