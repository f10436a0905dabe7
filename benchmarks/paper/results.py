"""Result files: `protocol.json` of the experiment and the JSON result of `benchmarks firmware`. One schema writes and reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uwb_mitigation.errors import DatasetError, UwbMitigationError
from uwb_mitigation.files import read_bounded
from uwb_mitigation.training.fit.options import FitOptions

RESULTS, MAX_BYTES = "protocol.json", 64 * 2**20
FORMS = ("float", "optimised", "int8")
"""Forms of a trained network, in the order of the paper's columns."""

TRIAL_EPOCHS = 2
"""Passes of each network of the search. More would change the order of networks with almost equal errors."""

Count = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Box = tuple[float, float, float, float, float]
"""Quantiles of signed errors, m: 5 %, 25 %, 50 %, 75 %, 95 %."""


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True)


class PartErrors(_Entry):
    """Errors on a part of the test data, m: MAE, standard deviation and quantiles before (`raw`) and after correction.

    If `n` is 0, all other fields have the value None.
    """

    n: Count
    mae_raw: Number | None = None
    sigma_raw: Number | None = None
    mae: Number | None = None
    sigma: Number | None = None
    box_raw: Box | None = None
    box: Box | None = None

    @classmethod
    def of(cls, raw_m: NDArray[np.floating], residual_m: NDArray[np.floating]) -> PartErrors:
        """Return the statistics of errors, shape (n,), before and after correction."""
        if len(raw_m) == 0:
            return cls(n=0)
        statistics: dict[str, Any] = {
            f"{name}{suffix}": value
            for suffix, error in (("_raw", raw_m), ("", residual_m))
            for name, value in (
                ("mae", np.abs(error).mean()),
                ("sigma", np.std(error)),
                ("box", tuple(np.percentile(error, (5, 25, 50, 75, 95)).tolist())),
            )
        }
        return cls(n=len(raw_m), **statistics)


class ErrorsByCondition(_Entry):
    """Errors on the test part, on its LOS part and on its NLOS part; rows without a label count in `all` only."""

    all: PartErrors
    los: PartErrors
    nlos: PartErrors

    @classmethod
    def of(
        cls, error_m: NDArray[np.floating], residual_m: NDArray[np.floating], labels: NDArray[np.str_]
    ) -> ErrorsByCondition:
        """Return the statistics of errors, shape (n,), before and after correction."""
        los = labels == "LOS"
        subsets = {"all": np.ones(len(labels), np.bool_), "los": los, "nlos": ~los & (labels != "")}
        return cls(**{name: PartErrors.of(error_m[rows], residual_m[rows]) for name, rows in subsets.items()})


class TrainedModel(_Entry):
    """One network, trained with one seed. Forms that a network does not have are omitted.

    Attributes:
        samples: window length K.
        parameters: without pruned weights.
        errors: {form: errors on the test part} (Table 1, Fig. 5).
        bytes: {form: file size}, and `zipped` of the int8 file (Table 2).
        seconds: processor time of the training, shared by the seeds.
    """

    network: str
    samples: Count
    seed: Count
    parameters: Count
    errors: Mapping[str, ErrorsByCondition]
    bytes: Mapping[str, Count]
    seconds: Number

    def maes(self) -> list[float | None]:
        """Return the MAE of each of `FORMS`, m."""
        return [self.errors[form].all.mae if form in self.errors else None for form in FORMS]

    @property
    def final_errors(self) -> ErrorsByCondition:
        """Errors of int8 if the network has this form, otherwise of float."""
        return self.errors.get("int8", self.errors["float"])


class RangeTest(_Entry):
    """Learning-rate range test.

    Attributes:
        rates, losses_m: of each step with a finite loss; running mean of the MAE.
        falls_from, falls_to: rates at which the loss has fallen by a tenth and by nine tenths of its decrease.
    """

    rates: tuple[Number, ...]
    losses_m: tuple[Number, ...]
    falls_from: Number
    falls_to: Number


class Trial(_Entry):
    """One network of the search: `stage` is `random` or `grid`, `shape` are the fields of `Remnet`; MAE on the validation part."""

    stage: str
    shape: Mapping[str, Count]
    parameters: Count
    multiply_accumulates: Count
    mae: Number
    is_on_front: bool


class ExperimentResults(_Entry):
    """Results of the paper's experiment.

    Attributes:
        train, test: numbers of measurements.
        options: options of every fit.
        median: errors after subtracting the median error of the training part.
        trials: networks of the random search and of the grid search.
    """

    data: str
    split: str
    command: str = ""
    train: Count
    test: Count
    options: FitOptions
    models: tuple[TrainedModel, ...]
    median: ErrorsByCondition | None = None
    range_test: RangeTest | None = None
    trials: tuple[Trial, ...] = ()

    def of(self, network: str, samples: int) -> tuple[TrainedModel, ...]:
        """Return the trained models of a network in the order of seeds."""
        statistics = [model for model in self.models if (model.network, model.samples) == (network, samples)]
        return tuple(sorted(statistics, key=lambda model: model.seed))


class FirmwareRow(_Entry):
    """One network on an emulated Cortex-M4; rate (64 MHz, no wait states) and energy are estimates, the rest is measured.

    Attributes:
        first_kernel: 0 for an MLP.
        energy_mj: at the paper's power; None if the paper has no such network.
        mismatches: number of outputs that differ from ONNX Runtime's.
    """

    network: str = Field(validation_alias="model")
    samples: Count = Field(validation_alias="k")
    first_kernel: Count = Field(validation_alias="k0")
    kernels: str
    instructions: Number
    ram_bytes: Number
    flash_bytes: Number
    rate_hz: Number = Field(validation_alias="hz")
    energy_mj: Number | None
    mismatches: Count
    inputs: Count


class FirmwareResults(_Entry):
    """The JSON result of `benchmarks firmware`."""

    rows: tuple[FirmwareRow, ...]


Entry = TypeVar("Entry", bound=BaseModel)


def read(kind: type[Entry], path: Path) -> Entry:
    """Return the content of a result file.

    Raises:
        UwbMitigationError: it cannot be read, is empty or too large.
        DatasetError: it is not a result file of this kind; `what` contains the invalid entry.
    """
    data = read_bounded(
        path, MAX_BYTES, UwbMitigationError, "output of `paper protocol` or `benchmarks firmware`"
    )
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        entry = ".".join(map(str, first["loc"])) or "the file"
        raise DatasetError(f"{entry}: {first['msg']}", where=str(path)) from error


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation (n - 1) over seeds; the latter is omitted (None) for a single seed."""

    mean: float
    std: float | None
    n: int

    @classmethod
    def of(cls, values: list[float | None]) -> Spread | None:
        """Return the spread of the values that are not None; None if all are None."""
        values_present = [value for value in values if value is not None]
        if not values_present:
            return None
        std = float(np.std(values_present, ddof=1)) if len(values_present) > 1 else None
        return cls(float(np.mean(values_present)), std, len(values_present))
