"""Files of results: `protocol.json` of the paper's experiment, and the firmware bench's JSON; one schema writes and reads.

No torch here: a report needs none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from uwb_mitigation.errors import DatasetError, UwbMitigationError
from uwb_mitigation.files import read_bounded

RESULTS = "protocol.json"
MAX_BYTES = 64 * 2**20
"""Of a file; the largest of ours are far smaller."""

MAX_MODELS = 10_000
FORMS = ("float", "optimised", "int8")
"""Of a trained network, in the order of the paper's columns."""


def clean(text: str, most: int = 120) -> str:
    """Text from outside, fit for a page: printable, of valid Unicode, and not longer than `most`."""
    valid = text.encode("utf-8", "replace").decode("utf-8")
    shown = "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in valid
    )
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


Text = Annotated[str, AfterValidator(clean)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Number = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)


class PartErrors(_Entry):
    """Errors left on a part of the test data, m. `n` may be 0; all else is then None.

    Attributes:
        mae: mean absolute error; `mae_raw` before any correction.
        sigma: standard deviation of the signed error; `sigma_raw` before.
    """

    n: Count
    mae_raw: Number | None
    sigma_raw: Number | None
    mae: Number | None
    sigma: Number | None

    @classmethod
    def of(cls, raw_m: NDArray[np.floating], left_m: NDArray[np.floating]) -> PartErrors:
        """Of errors of shape (n,), before and after."""
        if len(raw_m) == 0:
            return cls(n=0, mae_raw=None, sigma_raw=None, mae=None, sigma=None)
        return cls(
            n=len(raw_m),
            mae_raw=float(np.abs(raw_m).mean()),
            sigma_raw=float(np.std(raw_m)),
            mae=float(np.abs(left_m).mean()),
            sigma=float(np.std(left_m)),
        )


class ErrorsByCondition(_Entry):
    """Errors left on the test part, on those of it that are in line of sight, and on those that are not."""

    all: PartErrors
    los: PartErrors
    nlos: PartErrors


class TrainedModel(_Entry):
    """One network, trained with one seed. `None` where a network has no such form.

    Attributes:
        network, samples, seed: which; `samples` is the window length K.
        parameters, multiply_accumulates: of one inference.
        mae_float, mae_optimised, mae_int8: on the test part, m (Table 1).
        bytes_float, bytes_optimised, bytes_int8: of the files on disk (Table 2).
        float_errors, int8_errors: on the test part (Fig. 5).
        calibration_mae: {choice: MAE} of int8 on the training part, and `calibration`, the choice.
        seconds: of training, wall clock; `samples_per_s` of it.
    """

    network: Text
    samples: Count
    seed: Count
    parameters: Count
    multiply_accumulates: Count
    mae_raw: Number
    mae_float: Number
    mae_optimised: Number | None
    mae_int8: Number | None
    bytes_float: Count | None
    bytes_optimised: Count | None
    bytes_int8: Count | None
    float_errors: ErrorsByCondition
    int8_errors: ErrorsByCondition | None
    calibration: Text | None
    calibration_mae: Mapping[str, Number] | None
    seconds: Number
    samples_per_s: Number

    @property
    def name(self) -> str:
        """Begins the names of its files."""
        return f"{self.network}_{self.samples}_seed{self.seed}"

    @property
    def mae_m(self) -> tuple[float | None, ...]:
        """Of each of `FORMS`."""
        return self.mae_float, self.mae_optimised, self.mae_int8

    @property
    def size_bytes(self) -> tuple[int | None, ...]:
        """Of each of `FORMS`."""
        return self.bytes_float, self.bytes_optimised, self.bytes_int8

    @property
    def left(self) -> ErrorsByCondition:
        """Of int8 where there is one, else of float."""
        return self.int8_errors or self.float_errors


class Baseline(_Entry):
    """What needs no network, on the same split.

    Attributes:
        name: `los_median`, `overall_median` (of the training part's errors), or `line` (`evaluation.lad`).
        errors: on the test part; None where the data does not allow it.
        reason: why not; empty where there are errors.
    """

    name: Text
    errors: ErrorsByCondition | None
    reason: Text = ""


class Settings(_Entry):
    """Of every fit (see `training.options.FitOptions`)."""

    epochs: Count
    learning_rate: Number
    batch: Count
    dropout: Number
    weight_decay: Number
    seed: Count


class ExperimentResults(_Entry):
    """What the paper's experiment came to, and what it was measured on: what a table has to name beside its numbers.

    Attributes:
        data, split: names for people.
        train, test: measurements in each part.
        options: of every fit, but for the seed.
        baselines: empty in a file of an earlier version.
    """

    data: Text
    split: Text
    train: Count
    test: Count
    options: Settings
    models: Annotated[tuple[TrainedModel, ...], Field(max_length=MAX_MODELS)]
    baselines: Annotated[tuple[Baseline, ...], Field(max_length=MAX_MODELS)] = ()

    @model_validator(mode="after")
    def _each_once(self) -> ExperimentResults:
        names = [model.name for model in self.models]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"{twice} is there twice")
        return self

    @property
    def mae_raw(self) -> float | None:
        """Of the test part before correction, m."""
        return self.models[0].mae_raw if self.models else None

    def of(self, network: str, samples: int) -> tuple[TrainedModel, ...]:
        """Every seed of a network, in the order of seeds."""
        found = [model for model in self.models if (model.network, model.samples) == (network, samples)]
        return tuple(sorted(found, key=lambda model: model.seed))


class FirmwareRow(_Entry):
    """One network on an emulated Cortex-M4; cycles, rate and energy are estimates, the rest is measured.

    Attributes:
        network, samples, first_kernel, kernels: which; `first_kernel` is 0 for an MLP.
        instructions, cycles: of one inference.
        ram_bytes, flash_bytes: the arena, and an image that does nothing else.
        rate_hz: at 64 MHz without wait states.
        energy_mj: at the paper's power; None where the paper has none.
        mismatches, inputs: outputs that differ from ONNX Runtime's, of how many.
    """

    network: Text = Field(validation_alias="model")
    samples: Count = Field(validation_alias="k")
    first_kernel: Count = Field(validation_alias="k0")
    kernels: Text
    instructions: Number
    cycles: Number = Field(validation_alias="cycles_estimated")
    ram_bytes: Number
    flash_bytes: Number
    rate_hz: Number = Field(validation_alias="hz")
    energy_mj: Number | None
    mismatches: Count
    inputs: Count


class _FirmwareResults(_Entry):
    rows: Annotated[tuple[FirmwareRow, ...], Field(max_length=MAX_MODELS)]


Entry = TypeVar("Entry", bound=BaseModel)


def parse(kind: type[Entry], text: str | bytes, where: str) -> Entry:
    """The content of a JSON file.

    Raises:
        DatasetError: it is no such file; names the entry.
    """
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        entry = ".".join(map(str, first["loc"])) or "the whole"
        raise DatasetError(
            f"{entry}: {first['msg']}", where=where, valid="a result file of this program"
        ) from error


def parse_firmware(text: str | bytes, where: str) -> tuple[FirmwareRow, ...]:
    """The content of the JSON result of `uwb-mitigation bench firmware`; raises as `parse`."""
    return parse(_FirmwareResults, text, where).rows


def read_experiment(folder: Path) -> ExperimentResults:
    """The results of a finished run.

    Raises:
        UwbMitigationError: there are none. DatasetError: the file is damaged.
    """
    return parse(ExperimentResults, read(folder / RESULTS), str(folder / RESULTS))


def read(path: Path) -> bytes:
    """The content of a file of results.

    Raises:
        UwbMitigationError: it cannot be read, is empty, or is too large.
    """
    valid = "what `uwb-mitigation protocol` or `bench firmware` wrote"
    return read_bounded(path, MAX_BYTES, UwbMitigationError, valid)


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation over seeds; the latter is None for a single one."""

    mean: float
    std: float | None
    n: int

    @classmethod
    def of(cls, values: list[float | None]) -> Spread | None:
        """Of the values that are there; None if there are none."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        # Seeds are a sample of all seeds, hence n - 1.
        return cls(
            float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else None, len(known)
        )
