"""What the protocol and the firmware bench wrote, checked: the numbers that a report shows. No files are read here.

The training package defines what the protocol measures, but needs torch to be imported; a report does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from uwb_mitigation.errors import DatasetError

MAX_MODELS = 10_000
FORMS = ("float", "optimised", "int8")
"""Of a trained network, in the order of the paper's columns."""

PARTS = ("all", "los", "nlos")

_Row = TypeVar("_Row")


@dataclass(frozen=True, slots=True)
class Left:
    """Errors that a network leaves on a part of the test data, m; None where the part is empty."""

    n: int
    mae: float | None
    sigma: float | None


@dataclass(frozen=True, slots=True)
class Trained:
    """One network, trained with one seed.

    Attributes:
        network, samples, seed: which; `samples` is the window length K.
        parameters: trainable.
        mae_m, size_bytes: of each of `FORMS`; None where the network has no such form.
        left: {`all`, `los`, `nlos`: errors}, of int8 where there is one, else of float.
    """

    network: str
    samples: int
    seed: int
    parameters: int
    mae_m: tuple[float | None, ...]
    size_bytes: tuple[float | None, ...]
    left: Mapping[str, Left]

    @property
    def name(self) -> str:
        """Begins the names of its files."""
        return f"{self.network}_{self.samples}_seed{self.seed}"

    @property
    def is_int8(self) -> bool:
        """Whether `left` is of the int8 form."""
        return self.mae_m[FORMS.index("int8")] is not None


@dataclass(frozen=True, slots=True)
class Baseline:
    """What needs no network: the errors left on the test part; None, and why, where the data does not allow it."""

    name: str
    left: Left | None
    reason: str


@dataclass(frozen=True, slots=True)
class Trainings:
    """The results of a protocol, and what they were measured on.

    Attributes:
        data, split: names for people.
        train, test: measurements in each part.
        epochs, learning_rate: of every fit.
        mae_raw: of the test part before correction, m.
        baselines: on the same parts; empty in a file of an earlier version.
    """

    data: str
    split: str
    train: int
    test: int
    epochs: int
    learning_rate: float
    mae_raw: float | None
    models: tuple[Trained, ...]
    baselines: tuple[Baseline, ...] = ()

    def of(self, network: str, samples: int) -> tuple[Trained, ...]:
        """Every seed of a network, in the order of seeds."""
        found = [model for model in self.models if (model.network, model.samples) == (network, samples)]
        return tuple(sorted(found, key=lambda model: model.seed))


@dataclass(frozen=True, slots=True)
class FirmwareRow:
    """One network on an emulated Cortex-M4; cycles, rate and energy are estimates, the rest is measured.

    Attributes:
        network, samples, first_kernel, kernels: which; `first_kernel` is 0 for an MLP.
        instructions, cycles: of one inference.
        ram_bytes, flash_bytes: the arena, and an image that does nothing else.
        rate_hz: at 64 MHz without wait states.
        energy_mj: at the paper's power; None where the paper has none.
        mismatches, inputs: outputs that differ from ONNX Runtime's, of how many.
    """

    network: str
    samples: int
    first_kernel: int
    kernels: str
    instructions: float
    cycles: float
    ram_bytes: float
    flash_bytes: float
    rate_hz: float
    energy_mj: float | None
    mismatches: int
    inputs: int


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


def clean(text: str, most: int = 120) -> str:
    """Text from outside, fit for a page: printable, of valid Unicode, and not longer than `most`."""
    valid = text.encode("utf-8", "replace").decode("utf-8")
    shown = "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in valid
    )
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


def parse_trainings(values: object, where: str) -> Trainings:
    """The content of a `protocol.json`.

    Raises:
        DatasetError: it is not one; names the entry.
    """
    top = _Fields(values, where)
    options = _Fields(top.get("options"), f"{where}: options")
    models = top.rows("models", _trained)
    names = [model.name for model in models]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"{twice} is there twice", where=where, valid="each network, K and seed once")
    return Trainings(
        data=top.text("data"),
        split=top.text("split"),
        train=top.count("train"),
        test=top.count("test"),
        epochs=options.count("epochs"),
        learning_rate=options.number("learning_rate"),
        mae_raw=_Fields(top.get("models")[0], where).number("mae_raw") if models else None,
        models=models,
        baselines=top.rows("baselines", _baseline) if top.has("baselines") else (),
    )


def parse_firmware(values: object, where: str) -> tuple[FirmwareRow, ...]:
    """The content of the JSON result of `uwb-mitigation bench firmware`.

    Raises:
        DatasetError: it is not one; names the entry.
    """
    return _Fields(values, where).rows("rows", _firmware_row)


def _trained(fields: _Fields) -> Trained:
    is_int8 = fields.get("int8_errors") is not None
    errors = _Fields(fields.get("int8_errors" if is_int8 else "float_errors"), f"{fields.where}: errors")
    return Trained(
        network=fields.text("network"),
        samples=fields.count("samples"),
        seed=fields.count("seed"),
        parameters=fields.count("parameters"),
        mae_m=tuple(fields.optional(f"mae_{form}") for form in FORMS),
        size_bytes=tuple(fields.optional(f"bytes_{form}") for form in FORMS),
        left={part: _left(_Fields(errors.get(part), f"{errors.where}: {part}")) for part in PARTS},
    )


def _baseline(fields: _Fields) -> Baseline:
    errors = fields.get("errors")
    left = None if errors is None else _left(_Fields(_Fields(errors, fields.where).get("all"), fields.where))
    return Baseline(fields.text("name"), left, fields.text("reason"))


def _left(fields: _Fields) -> Left:
    return Left(fields.count("n"), fields.optional("mae"), fields.optional("sigma"))


def _firmware_row(fields: _Fields) -> FirmwareRow:
    return FirmwareRow(
        network=fields.text("model"),
        samples=fields.count("k"),
        first_kernel=fields.count("k0"),
        kernels=fields.text("kernels"),
        instructions=fields.number("instructions"),
        cycles=fields.number("cycles_estimated"),
        ram_bytes=fields.number("ram_bytes"),
        flash_bytes=fields.number("flash_bytes"),
        rate_hz=fields.number("hz"),
        energy_mj=fields.optional("energy_mj"),
        mismatches=fields.count("mismatches"),
        inputs=fields.count("inputs"),
    )


class _Fields:
    """The entries of a JSON object, each checked when it is asked for."""

    def __init__(self, values: object, where: str) -> None:
        self.where = where
        if not isinstance(values, dict):
            raise DatasetError("not an object", where=where, valid="a result file of this program")
        self._values: dict[str, Any] = values

    def _refused(self, key: str, valid: str) -> DatasetError:
        return DatasetError(f"entry {key!r} is missing or wrong", where=self.where, valid=valid)

    def has(self, key: str) -> bool:
        return key in self._values

    def get(self, key: str) -> Any:
        if key not in self._values:
            raise self._refused(key, "a result file of this program")
        return self._values[key]

    def text(self, key: str) -> str:
        value = self.get(key)
        if not isinstance(value, str):
            raise self._refused(key, "text")
        return clean(value)

    def number(self, key: str) -> float:
        value = self.get(key)
        # A whole number may be too large for a float, and JSON's reader accepts NaN.
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e15:
            raise self._refused(key, "a number from 0 to 1e15")
        return float(value)

    def optional(self, key: str) -> float | None:
        return None if self.get(key) is None else self.number(key)

    def count(self, key: str) -> int:
        value = self.number(key)
        if not math.floor(value) == value:
            raise self._refused(key, "a whole number")
        return int(value)

    def rows(self, key: str, parse: Callable[[_Fields], _Row]) -> tuple[_Row, ...]:
        values = self.get(key)
        if not isinstance(values, list) or len(values) > MAX_MODELS:
            raise self._refused(key, f"a list of at most {MAX_MODELS}")
        return tuple(
            parse(_Fields(value, f"{self.where}: {key}[{number}]")) for number, value in enumerate(values)
        )
