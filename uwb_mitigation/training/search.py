"""Architecture search (paper, section III-B): random search, then a grid around the best that it found.

Every trial is a line of a journal, so that an interrupted search goes on where it stopped. Trials are judged
on a validation part; the test data has no say.
"""

from __future__ import annotations

import itertools
import json
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from uwb_mitigation.dataset import Dataset
from uwb_mitigation.errors import DatasetError, ParameterError, UwbMitigationError
from uwb_mitigation.evaluation.splits import by_configuration
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.training import parallel
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.parts import narrowed

SPACE: Mapping[str, tuple[int, ...]] = {
    "modules": (1, 2, 3, 4),
    "first_kernel": (3, 5, 7),
    "kernel": (3, 5),
    "filters": (4, 8, 12, 16, 24),
}
"""N, k0, kn and F; the window length K is searched over what is asked for."""


VALIDATION_FOLDS = 5
"""Of the training part's configurations; on one of them networks are judged."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Attributes:
    architecture: of the network.
    mae_m: on the validation part, m; None where training diverged.
    stage: `random` or `grid`.
    """

    architecture: Remnet
    mae_m: float | None
    stage: str

    @property
    def multiply_accumulates(self) -> int:
        return self.architecture.multiply_accumulates


def front(trials: Sequence[Trial]) -> list[Trial]:
    """The trials that no other beats in both MAE and multiply-accumulates, cheapest first."""
    best: list[Trial] = []
    measured = [trial for trial in trials if trial.mae_m is not None]
    for trial in sorted(measured, key=lambda trial: (trial.multiply_accumulates, trial.mae_m)):
        if not best or trial.mae_m < best[-1].mae_m:  # type: ignore[operator]
            best.append(trial)
    return best


def search(
    known: Dataset,
    journal: Path,
    options: FitOptions,
    *,
    random: int,
    grid: int,
    windows: Sequence[int] = (),
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Trial]:
    """Try `random` networks drawn from `SPACE`, then up to `grid` neighbours of the best of them.

    Args:
        known: a training part; one of `VALIDATION_FOLDS` of its configurations judges, the others are fitted to.
        journal: a file of one JSON object a line; its trials on the same data and options are not repeated.
        options: of every fit; its seed also draws the networks.
        windows: lengths K; without any, that of the data.
        on_progress: called with the share of the work that is done, 0 to 1.

    Raises:
        ParameterError: nothing to try, or a window longer than the data's.
        DatasetError: every network diverged, or there are too few configurations.
        UwbMitigationError: the journal cannot be read or written.
    """
    longest = known.preprocessing.samples
    windows = tuple(windows) or (longest,)
    if random < 1 or grid < 0 or max(windows) > longest or min(windows) < 1:
        raise ParameterError(
            f"{random} random trials, {grid} of a grid, windows {windows}",
            valid=f"at least 1, at least 0, 1 to {longest}",
        )
    fold = by_configuration(known.configurations, VALIDATION_FOLDS, seed=0)[0]
    train, validation = known.rows(fold.train), known.rows(fold.test)
    mark = _fingerprint(train, validation, options)
    worker = _Worker(train, validation, journal, options, mark)
    drawn = _draw(random, windows, options.seed)
    _try(worker, drawn, "random", workers, lambda share: on_progress(share * random / (random + grid)))
    trials = [trial for trial in _read(journal, mark) if trial.architecture in drawn]
    measured = [trial for trial in trials if trial.mae_m is not None]
    if not measured:
        raise DatasetError("every network diverged", valid="a lower learning rate")
    best = min(measured, key=lambda trial: trial.mae_m or 0.0)
    near = [shape for shape in _neighbours(best.architecture) if shape not in drawn][:grid]
    _try(worker, near, "grid", workers, lambda share: on_progress((random + share * grid) / (random + grid)))
    on_progress(1.0)
    return [trial for trial in _read(journal, mark) if trial.architecture in (*drawn, *near)]


def _draw(count: int, windows: Sequence[int], seed: int) -> list[Remnet]:
    """Different networks in random order; all of them where there are no more than `count`."""
    every = [
        Remnet(samples, **dict(zip(SPACE, values, strict=True)))
        for samples in windows
        for values in itertools.product(*SPACE.values())
    ]
    order = np.random.default_rng(seed).permutation(len(every))
    return [every[index] for index in order[:count]]


def _neighbours(centre: Remnet) -> list[Remnet]:
    """The grid of one step either way along each axis, the fewest steps first."""
    axes = []
    for name, values in SPACE.items():
        place = values.index(getattr(centre, name))
        axes.append(
            [(name, values[i], abs(i - place)) for i in range(place - 1, place + 2) if 0 <= i < len(values)]
        )
    grid = sorted(itertools.product(*axes), key=lambda point: sum(step for _, _, step in point))
    return [replace(centre, **{name: value for name, value, _ in point}) for point in grid]


def _try(
    worker: _Worker,
    shapes: Sequence[Remnet],
    stage: str,
    workers: int,
    on_progress: Callable[[float], None],
) -> None:
    known = {trial.architecture for trial in _read(worker.journal, worker.mark)}
    missing = [(shape, stage) for shape in shapes if shape not in known]
    total = sum(shape.multiply_accumulates for shape in shapes) or 1
    done = total - sum(shape.multiply_accumulates for shape, _ in missing)
    parallel.each(worker, missing, workers, lambda amount: on_progress(min((done + amount) / total, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Worker:
    """Does one trial; sent to each process once."""

    train: Dataset
    validation: Dataset
    journal: Path
    options: FitOptions
    mark: int

    def __call__(self, job: tuple[Remnet, str], advance: Callable[[float], None]) -> None:
        shape, stage = job
        train, validation = (narrowed(part, shape.samples) for part in (self.train, self.validation))
        step = shape.multiply_accumulates / self.options.epochs
        mae = None
        try:
            weights = fit(shape, train.inputs, train.error_m, self.options, lambda: advance(step))
            left = validation.error_m - floating.predict_m(weights, validation.inputs)
            mae = float(np.abs(left).mean())
        except DatasetError:
            # A network that diverges is a result too: the search goes on without it.
            pass
        line = json.dumps({"fingerprint": self.mark, **asdict(Trial(shape, mae, stage))}) + "\n"
        _append(self.journal, line)


def _append(journal: Path, line: str) -> None:
    """One write to a file opened for appending: lines of several processes do not mix."""
    try:
        handle = os.open(journal, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(handle, line.encode())
        finally:
            os.close(handle)
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(journal)) from error


def _read(journal: Path, mark: int) -> list[Trial]:
    """The trials of a journal that were made on this data; a torn line is skipped."""
    try:
        lines = journal.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UwbMitigationError(f"cannot be read: {error.strerror}", where=str(journal)) from error
    trials = (trial for line in lines if (trial := _parse(line, mark)) is not None)
    return list({trial.architecture: trial for trial in trials}.values())


def _parse(line: str, mark: int) -> Trial | None:
    try:
        values = json.loads(line)
        if values["fingerprint"] != mark:
            return None
        mae_m = values["mae_m"]
        return Trial(
            Remnet(**values["architecture"]), None if mae_m is None else float(mae_m), values["stage"]
        )
    except (ValueError, TypeError, KeyError, AttributeError, ParameterError):
        return None


def _fingerprint(train: Dataset, validation: Dataset, options: FitOptions) -> int:
    mark = zlib.crc32(json.dumps(asdict(options), sort_keys=True).encode())
    for part in (train, validation):
        for array in (part.inputs, part.error_m):
            mark = zlib.crc32(array.tobytes(), mark)
    return mark
