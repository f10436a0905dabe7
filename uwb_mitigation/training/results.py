"""What a run of the protocol comes to, and its file `protocol.json`. No torch here: a report needs none."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.training.options import FitOptions

RESULTS = "protocol.json"


@dataclass(frozen=True, slots=True)
class PartErrors:
    """Errors left on a part of the test data, m. `n` may be 0; all else is then None.

    Attributes:
        mae: mean absolute error; `mae_raw` before any correction.
        sigma: standard deviation of the signed error; `sigma_raw` before.
    """

    n: int
    mae_raw: float | None
    sigma_raw: float | None
    mae: float | None
    sigma: float | None

    @classmethod
    def of(cls, raw_m: NDArray[np.floating], left_m: NDArray[np.floating]) -> PartErrors:
        if len(raw_m) == 0:
            return cls(0, None, None, None, None)
        return cls(
            len(raw_m),
            float(np.abs(raw_m).mean()),
            float(np.std(raw_m)),
            float(np.abs(left_m).mean()),
            float(np.std(left_m)),
        )


@dataclass(frozen=True, slots=True)
class TrainedModel:
    """What one network came to. `None` where a network has no such form.

    Attributes:
        network, samples, seed: see `Job`.
        parameters, multiply_accumulates: of one inference.
        mae_float, mae_optimised, mae_int8: on the test part, m (Table 1).
        bytes_float, bytes_optimised, bytes_int8: of the files on disk (Table 2).
        float_errors, int8_errors: {`all`, `los`, `nlos`: errors} on the test part (Fig. 5).
        calibration_mae: {choice: MAE} of int8 on the training part, and `calibration`, the choice.
        seconds: of training, wall clock; `samples_per_s` of it.
    """

    network: str
    samples: int
    seed: int
    parameters: int
    multiply_accumulates: int
    mae_raw: float
    mae_float: float
    mae_optimised: float | None
    mae_int8: float | None
    bytes_float: int | None
    bytes_optimised: int | None
    bytes_int8: int | None
    float_errors: Mapping[str, PartErrors]
    int8_errors: Mapping[str, PartErrors] | None
    calibration: str | None
    calibration_mae: Mapping[str, float] | None
    seconds: float
    samples_per_s: float

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TrainedModel:
        """The model of a results file; raises KeyError, TypeError or ValueError where it is not one."""
        parts = {key: _errors(values[key]) for key in ("float_errors", "int8_errors")}
        return cls(**(dict(values) | parts))


@dataclass(frozen=True, slots=True)
class Baseline:
    """What needs no network, on the same split.

    Attributes:
        name: `los_median`, `overall_median` (of the training part's errors), or `line` (`evaluation.lad`).
        errors: {`all`, `los`, `nlos`: errors} on the test part; None where the data does not allow it.
        reason: why not; empty where there are errors.
    """

    name: str
    errors: Mapping[str, PartErrors] | None
    reason: str = ""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Baseline:
        """The baseline of a results file; raises KeyError, TypeError or ValueError where it is not one."""
        return cls(**(dict(values) | {"errors": _errors(values["errors"])}))


@dataclass(frozen=True, slots=True)
class Protocol:
    """Results, and what they were measured on: what a table has to name beside its numbers.

    Attributes:
        data, split: names for people.
        train, test: measurements in each part.
        options: of every fit, but for the seed.
        baselines: empty in a file of an earlier version.
    """

    data: str
    split: str
    train: int
    test: int
    options: FitOptions
    models: tuple[TrainedModel, ...]
    baselines: tuple[Baseline, ...] = ()


def _errors(values: Any) -> dict[str, PartErrors] | None:
    return None if values is None else {name: PartErrors(**part) for name, part in values.items()}


def read(folder: Path) -> Protocol:
    """The results of a finished run.

    Raises:
        UwbMitigationError: there are none, or the file is damaged.
    """
    path = folder / RESULTS
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        models = tuple(TrainedModel.from_json(model) for model in values["models"])
        baselines = tuple(Baseline.from_json(baseline) for baseline in values.get("baselines", ()))
        parts = {"options": FitOptions(**values["options"]), "models": models, "baselines": baselines}
        return Protocol(**(values | parts))
    except OSError as error:
        reason = error.strerror or str(error)
    except (ValueError, TypeError, KeyError, AttributeError, UwbMitigationError) as error:
        reason = f"not results of a run: {error}"
    raise UwbMitigationError(reason, where=str(path), valid="run `uwb-mitigation protocol` first")


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write `values` to `path`, whole or not at all, whichever process writes it too.

    Raises:
        UwbMitigationError: the file cannot be written.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        partial.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise UwbMitigationError(f"cannot be written: {error.strerror}", where=str(path)) from error
