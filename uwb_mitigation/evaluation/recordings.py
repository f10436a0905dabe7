"""Read a recording as a dataset for training, calibration or evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.evaluation import dataset as datasets
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.measurement import Record, Truth
from uwb_mitigation.preprocessing import CirFault, Preprocessing, Scaling
from uwb_mitigation.sources import opening
from uwb_mitigation.sources.truth_table import load_truth, with_truth


def load(
    path: Path,
    preprocessing: Preprocessing,
    truth: Sequence[Path] = (),
    on_record: Callable[[], None] = lambda: None,
) -> tuple[str, Dataset]:
    """Return the name of a recording (marked "simulated" if it is) and its labelled measurements.

    Args:
        truth: tables of true ranges that replace those of the recording.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no measurement is usable.
    """
    stretches = [row for table in truth for row in load_truth(table)]
    with opening.open_recording(path) as source:
        try:
            read = with_truth(source, stretches) if stretches else source
            dataset = datasets.build_dataset(read, preprocessing, on_record)
        except DatasetError as error:
            if preprocessing.scaling is Scaling.MAX or CirFault.NO_PREAMBLE_COUNT.text not in error.what:
                raise
            raise DatasetError(error.what, valid="--scaling max does without preamble counts") from error
        name = path.resolve().name
        is_said = "simulated" in name or not source.simulated
    return (name if is_said else f"{name} (simulated)"), dataset


def load_inputs(
    path: Path, preprocessing: Preprocessing, on_record: Callable[[], None] = lambda: None
) -> Dataset:
    """Return the measurements of a recording with or without true ranges; do not use their errors.

    Without ground truth, each minute of a pair is one configuration.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no CIR is usable.
    """
    with opening.open_recording(path) as source:
        return datasets.build_dataset(map(_named, source), preprocessing, on_record)


def _named(record: Record) -> Record:
    if record.truth is not None:
        return record
    measured = record.measurement
    minute = measured.stamp_ns // 60_000_000_000
    name = f"tag {measured.tag_id}/anchor {measured.anchor_id}/minute {minute}"
    return replace(record, truth=Truth(measured.range_m, configuration=name))
