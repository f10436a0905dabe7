"""Read a recording as a dataset for training, calibration or evaluation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.recordings import formats
from uwb_mitigation.recordings.csv_tables import load_truth, with_truth
from uwb_mitigation.training.data import dataset as datasets
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.types.measurement import CirFault, Record, Truth

Counted = Callable[[Iterable[Record]], Iterator[Record]]


def load_dataset(
    path: Path,
    preprocessing: Preprocessing,
    truth: Sequence[Path] = (),
    counted: Counted = iter,
) -> tuple[str, Dataset]:
    """Return the name of a recording (marked "simulated" if it is) and its labelled measurements.

    Args:
        path: a bag, or another recording.
        preprocessing: preprocessing of the model.
        truth: tables of true ranges that replace those of the recording.
        counted: passes the records on, and shows their number.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no measurement is usable.
    """
    table = load_truth(*truth)
    with formats.open_recording(path) as source:
        try:
            records = with_truth(source, table) if table else source
            dataset = datasets.build_dataset(counted(records), preprocessing)
        except DatasetError as error:
            if preprocessing.scaling is Scaling.MAX or CirFault.NO_PREAMBLE_COUNT.text not in error.what:
                raise
            raise DatasetError(error.what, valid="--scaling max, which needs no preamble counts") from error
        name = path.resolve().name
        is_marked = "simulated" in name or not source.simulated
    return (name if is_marked else f"{name} (simulated)"), dataset


def load_inputs(path: Path, preprocessing: Preprocessing, counted: Counted = iter) -> Dataset:
    """Return the measurements of a recording with or without true ranges; do not use their errors.

    Without ground truth, each minute of a pair is one configuration.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no CIR is usable.
    """
    with formats.open_recording(path) as source:
        dataset = datasets.build_dataset(counted(map(_with_configuration, source)), preprocessing)
    if not dataset.has_cirs:
        raise DatasetError("the recording has no CIRs", where=path)
    return dataset


def _with_configuration(record: Record) -> Record:
    if record.truth is not None:
        return record
    measured = record.measurement
    minute = measured.stamp_ns // 60_000_000_000
    name = f"tag {measured.tag_id}/anchor {measured.anchor_id}/minute {minute}"
    return replace(record, truth=Truth(measured.range_m, configuration=name))
