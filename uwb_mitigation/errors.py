"""The exceptions of this package: a base class, and a subclass for each kind of input.

Each contains the problem, its location in the input, and the valid values as separate attributes for the caller.
No other module defines exceptions.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from functools import partial
from numbers import Integral, Real


class UwbMitigationError(Exception):
    """Base class of all errors of this package.

    Attributes:
        what: the problem, with the invalid value.
        where: location in the input (file, line, byte offset, field); may be empty.
        valid: valid values, or the remedy; may be empty.
        suggestion: for an unknown name, the question of `did_you_mean`; may be empty.
    """

    def __init__(self, what: str, *, where: object = "", valid: str = "", suggestion: str = "") -> None:
        super().__init__(what, str(where), valid, suggestion)
        self.what = what
        self.where = str(where)
        self.valid = valid
        self.suggestion = suggestion

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        suggestion = f"; {self.suggestion}" if self.suggestion else ""
        remedy = f" ({self.valid})" if self.valid else ""
        return f"{place}{self.what}{suggestion}{remedy}"

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword arguments do not survive the default pickling that process pools use.
        place = {"where": self.where, "valid": self.valid, "suggestion": self.suggestion}
        return partial(type(self), self.what, **place), ()


class RecordingError(UwbMitigationError):
    """A recording is missing, has another format, or does not contain the requested data."""


class DamagedRecordingError(RecordingError):
    """A recording is damaged; everything before the damage has been yielded."""


class ModelError(UwbMitigationError):
    """A model file is missing, corrupt, or unsuitable for its use."""


class DatasetError(UwbMitigationError):
    """Labelled data is not sufficient: too few, without truth, or not finite."""


class ParameterError(UwbMitigationError):
    """A parameter or option is unknown, of the wrong type, or out of its range."""


class LinkError(UwbMitigationError):
    """Data from a board violates the protocol, or its port cannot be used."""


class MissingDependencyError(UwbMitigationError):
    """An optional dependency is not installed."""


def did_you_mean(name: object, valid_names: Iterable[object]) -> str:
    """Return a did-you-mean question with the most similar valid names; empty if none is similar."""
    by_lower_case = {str(candidate).lower(): str(candidate) for candidate in valid_names}
    close = difflib.get_close_matches(str(name)[:100].lower(), by_lower_case, n=2)
    return f"did you mean {' or '.join(repr(by_lower_case[match]) for match in close)}?" if close else ""


def check_name(
    what: str, name: object, valid_names: Iterable[object], where: str = "", valid: str = ""
) -> None:
    """Check that `name` is one of the valid names.

    Args:
        what: what has the name, such as "split".
        name: the name, which may be an untrusted value of any type.
        valid_names: the valid names.
        where: location in the input.
        valid: text for `valid` of the error; default: the valid names.

    Raises:
        ParameterError: the name is unknown; it suggests similar names.
    """
    names = list(valid_names)
    if name not in names:
        valid = valid or f"one of {', '.join(map(str, names))}"
        raise ParameterError(
            f"unknown {what} {name!r:.60}", where=where, valid=valid, suggestion=did_you_mean(name, names)
        )


def check_range(where: str, name: str, value: float, low: float, high: float, *, whole: bool = False) -> None:
    """Raise a ParameterError that names all of them, unless `value` is a number from `low` to `high`.

    NaN is rejected; with `whole`, also a number that is not an integer.
    """
    checked: object = value
    if not isinstance(checked, Integral if whole else Real) or not low <= value <= high:
        kind = "a whole number from " if whole else ""
        raise ParameterError(f"{name} = {value!r}", where=where, valid=f"{kind}{low:g} to {high:g}")


_DISTRIBUTIONS = {"serial": "pyserial", "sklearn": "scikit-learn", "yaml": "pyyaml"}
"""{name of the import: name of the package}, if they differ."""

_DOCTOR = "run uwb-mitigation doctor"
_REMEDIES = dict.fromkeys(("torch", "sklearn", "threadpoolctl"), "run `make setup-training`") | {
    "distributed": "python -m pip install distributed"
}
"""{name of the import of an optional package: how to install it}."""


def missing_dependency(error: ImportError) -> MissingDependencyError | None:
    """Return the error for a library that cannot be imported; None for a module of this package, which is a bug."""
    module = (error.name or "").partition(".")[0]
    if module in ("", "uwb_mitigation"):
        return None
    if not isinstance(error, ModuleNotFoundError):
        return MissingDependencyError(f"{module} cannot be used: {error}", valid=_DOCTOR)
    if module.startswith(
        ("rcl", "rosidl", "builtin_interfaces", "lifecycle_msgs", "ament")
    ) or module.endswith("_msgs"):
        return MissingDependencyError(
            f"ROS 2 is not set up: {module} is missing",
            valid="source the setup.sh of ROS and of the workspace; see uwb-mitigation doctor",
        )
    return not_installed(_DISTRIBUTIONS.get(module, module), _REMEDIES.get(module, _DOCTOR))


def not_installed(package: str, remedy: str = _DOCTOR) -> MissingDependencyError:
    """Return the error for a package that cannot be found."""
    return MissingDependencyError(f"{package} is not installed", valid=remedy)


def format_id(number: int) -> str:
    """Return an id of a tag, anchor or board as text: small numbers in decimal, others as `0x` and 16 hex digits."""
    return str(number) if number < 1 << 16 else f"0x{number:016x}"


def parse_id(text: str) -> int:
    """Parse an id in the format of `format_id`; raise ValueError for any other text.

    A larger decimal number is rejected: it is probably a hexadecimal address without `0x`.
    """
    if re.fullmatch(r"0[xX][0-9a-fA-F]{1,16}", text):
        return int(text, 16)
    if re.fullmatch(r"[0-9]{1,5}", text) and int(text) < 1 << 16:
        return int(text)
    raise ValueError(f"not an id: {text}")
