"""What a report is made of, read from files: labelled data, and the errors that trained networks leave on it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.dataset import build_dataset
from uwb_mitigation.errors import ModelError
from uwb_mitigation.evaluation import paper
from uwb_mitigation.evaluation.results import ExperimentResults
from uwb_mitigation.evaluation.study import Study, agrees
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.runtime import Session
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.sources.opening import open_recording


def read_study(data: Path, simulated: bool, on_record: Callable[[], None] = lambda: None) -> Study:
    """A recording with true ranges, scaled by the preamble count where its radio reports one, else by the maximum.

    Args:
        simulated: whether it is, though it may not say so.

    Raises:
        RecordingError, DatasetError: it cannot be read, or holds nothing that can be used.
    """
    with open_recording(data) as source:
        records = iter(source)
        first = list(itertools.islice(records, 1))
        knows_count = bool(first) and first[0].measurement.cir.preamble_count > 0
        scaling = Scaling.PREAMBLE if knows_count else Scaling.MAX
        preprocessing = Preprocessing(max(paper.WINDOWS), scaling)
        dataset = build_dataset(itertools.chain(first, records), preprocessing, on_record)
        # Without the way to its folder: a page is passed on.
        name = source.name.replace(str(data), data.resolve().name)
        return Study.of(name, source.simulated or simulated, dataset)


def errors_left(
    study: Study, trainings: ExperimentResults, folder: Path, on_fault: Callable[[ModelError], None]
) -> dict[int, NDArray[np.floating]]:
    """{K: errors that REMNet leaves on the test part, m, of all seeds}, by the bundles in `folder`.

    A bundle that does not leave what its results say is left out; one that cannot be read is told to `on_fault`.
    """
    rows = study.test_rows(trainings.test, trainings.mae_raw)
    found: dict[int, list[NDArray[np.floating]]] = {}
    if rows is None:
        return {}
    for model in (model for samples in paper.WINDOWS for model in trainings.of("remnet", samples)):
        try:
            bundle = load_bundle(folder / f"{model.name}_{'int8' if model.int8_errors else 'float'}.onnx")
        except ModelError as error:
            on_fault(error)
            continue
        if (inputs := study.window(rows, bundle.card.preprocessing)) is None:
            continue
        left = study.dataset.error_m[rows] - Session(bundle).predict_batch_m(inputs)
        if agrees(model, left):
            found.setdefault(model.samples, []).append(left)
    return {samples: np.concatenate(parts) for samples, parts in found.items()}
