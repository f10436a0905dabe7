"""Columns of a pickled pandas data frame, read as data: pandas is not needed and nothing of it runs.

`pickle_machine` gives the pickle's structure, which this module knows for frames that pandas 0.25 to 3 wrote
with numpy 1 and 2: a block manager, blocks of like columns, and within them arrays, categories and text.
Text that pandas holds in Arrow buffers is refused by name like anything else that is not in `_MODULES`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.sources.pickle_machine import Made, Name, interpret

Column: TypeAlias = "NDArray[Any] | list[Any]"
"""One value a row: an array of numbers, or a list of whatever the frame's cells hold (see `numbers`)."""

MAX_FILE_BYTES = 1 << 29
"""Ceiling on the file."""

MAX_COLUMNS = 1000
"""Ceiling on the frame's columns."""

VALID = "a data frame that pandas wrote with `to_pickle`, uncompressed"

_CORE = "pandas.core."
_MODULES = {
    "DataFrame": ("pandas", _CORE + "frame"),
    "BlockManager": (_CORE + "internals.managers", _CORE + "internals"),
    "_unpickle_block": ("pandas._libs.internals",),
    "_new_Index": (_CORE + "indexes.base",),
    "Index": ("pandas", _CORE + "indexes.base"),
    "RangeIndex": ("pandas", _CORE + "indexes.range"),
    "Int64Index": (_CORE + "indexes.numeric",),
    "Categorical": ("pandas", _CORE + "arrays.categorical"),
    "CategoricalDtype": ("pandas", _CORE + "dtypes.dtypes"),
    "StringArray": ("pandas.arrays", _CORE + "arrays.string_"),
    "StringDtype": ("pandas", _CORE + "arrays.string_"),
    "NA": ("pandas", "pandas._libs.missing"),
    "__pyx_unpickle_NDArrayBacked": ("pandas._libs.arrays",),
    "slice": ("builtins", "__builtin__"),
    "ndarray": ("numpy",),
    "dtype": ("numpy",),
    "_reconstruct": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "scalar": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "_frombuffer": ("numpy.core.numeric", "numpy._core.numeric"),
    "encode": ("_codecs",),
}
"""All that a pickle may refer to: {name: modules it has had}. Within it the name alone tells what is meant."""

_ALLOWED = frozenset(Name(module, name) for name, modules in _MODULES.items() for module in modules)

_NUMERIC = re.compile(r"f[248]|[iu][1248]|b1")
_MOST_SHOWN = 12


def read_columns(path: Path, wanted: Sequence[str]) -> dict[str, Column]:
    """The columns named `wanted` of the data frame in `path`, in the order of the frame's rows, and of one length.

    Raises:
        RecordingError: the file is absent or too large; the pickle is damaged, or refers to anything but
            arrays and frames (named in the error); it is no data frame, or lacks a column.
    """
    root = interpret(_content(path), _ALLOWED, str(path))
    try:
        return _columns(root, wanted)
    except _Malformed as error:
        raise RecordingError(str(error), where=str(path), valid=VALID) from None


def numbers(cell: Any) -> NDArray[np.float64] | None:
    """A cell's numbers, float64: (n,) of an array, list or tuple, (1,) of a single number; None if it holds others."""
    try:
        if type(cell) is Made and _role(cell) != "scalar":
            values, shape = _array(cell)
            if len(shape) != 1:
                return None
            cell = values
        elif type(cell) not in (list, tuple):
            cell = [cell]
        if isinstance(cell, np.ndarray):
            return cell.astype(np.float64)
        if any(type(value) is not float for value in cell):
            cell = [_number(value) for value in cell]
    except _Malformed:
        return None
    return np.array(cell, np.float64)


class _Malformed(Exception):
    """What of the structure is not that of a data frame."""


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise RecordingError("no such file", where=str(path), valid=VALID)
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise RecordingError(f"cannot open: {error.strerror}", where=str(path)) from error
    if not data:
        raise RecordingError("the file is empty", where=str(path), valid=VALID)
    if len(data) > MAX_FILE_BYTES:
        raise RecordingError(f"more than {MAX_FILE_BYTES} bytes", where=str(path), valid="a smaller file")
    return data


def _columns(root: Any, wanted: Sequence[str]) -> dict[str, Column]:
    state = _of(root, "DataFrame").state
    manager = None
    if type(state) is dict:
        manager = state.get("_mgr", state.get("_data"))  # the latter before pandas 1.1
    axes, blocks = _manager(_of(manager, "BlockManager"))
    names = _index(axes[0])
    if max(len(names), len(blocks)) > MAX_COLUMNS:
        raise _Malformed(f"more than {MAX_COLUMNS} columns")
    places: dict[str, int] = {}
    for number, name in enumerate(names):
        if type(name) is str:
            places.setdefault(name, number)
    missing = [name for name in wanted if name not in places]
    if missing:
        shown = ", ".join(repr(name[:40]) for name in list(places)[:_MOST_SHOWN])
        raise _Malformed(f"no column {missing[0]!r} among {shown or 'none'}")

    found: dict[int, Column] = {}
    needed = {places[name] for name in wanted}
    for values, placement in blocks:
        for row, number in enumerate(_placement(placement, len(names))):
            if number in needed:
                found[number] = _column(values, row)
    if needed - found.keys():
        raise _Malformed("a column without values")
    columns = {name: found[places[name]] for name in wanted}
    if len({len(column) for column in columns.values()}) > 1:
        raise _Malformed("columns of different lengths")
    return columns


def _manager(manager: Made) -> tuple[Sequence[Any], list[tuple[Any, Any]]]:
    """The axes of a block manager, and the values and placement of each of its blocks."""
    if manager.args:  # since pandas 1.3
        blocks, axes = _sequence(manager.args, 2)
        parts = [_of(block, "_unpickle_block").args for block in _sequence(blocks)]
        return _sequence(axes, 2), [(part[0], part[1]) for part in parts if len(_sequence(part, 3)) == 3]
    state = manager.state
    extra = (
        state[3].get("0.14.1")
        if type(state) is tuple and len(state) == 4 and type(state[3]) is dict
        else None
    )
    if type(extra) is not dict:
        raise _Malformed("a block manager without blocks")
    old = _sequence(extra.get("blocks"))
    if not all(type(block) is dict and {"values", "mgr_locs"} <= block.keys() for block in old):
        raise _Malformed("a block without values")
    return _sequence(extra.get("axes"), 2), [(block["values"], block["mgr_locs"]) for block in old]


def _placement(node: Any, count: int) -> Sequence[int] | NDArray[Any]:
    """Which columns of the frame the rows of a block are."""
    if type(node) is Made and _role(node) == "slice":
        bounds = _sequence(node.args, 3)
        if any(type(bound) not in (int, type(None)) for bound in bounds) or bounds[2] == 0:
            raise _Malformed("a slice that is none")
        return range(*slice(*bounds).indices(count))
    values, shape = _array(node)
    if (
        not isinstance(values, np.ndarray)
        or values.dtype.kind not in "iu"
        or len(shape) != 1
        or shape[0] > count
    ):
        raise _Malformed("a block in no place")
    return values


def _column(node: Any, row: int) -> Column:
    """One row of a block's values; a block of categories or text has only one."""
    if type(node) is Made and _role(node) not in ("_reconstruct", "_frombuffer"):
        if row != 0:
            raise _Malformed("a block in more places than it has columns")
        return _extension(node)
    values, shape = _array(node)
    if len(shape) != 2 or row >= shape[0]:
        raise _Malformed("a block that is not as high as its place")
    if isinstance(values, np.ndarray):
        return values[row]  # type: ignore[no-any-return]
    return values[row * shape[1] : (row + 1) * shape[1]]


def _index(node: Any) -> Sequence[Any]:
    """The labels of an index, for the names of columns."""
    kind, state = _sequence(_of(node, "_new_Index").args, 2)
    data = state.get("data") if type(kind) is Name and kind.name == "Index" and type(state) is dict else None
    return list(_flat(data)) if type(data) is Made else []


def _extension(node: Any) -> Column:
    """The values of a `Categorical` or `StringArray`, of any age."""
    kind = _role(node)
    if kind == "__pyx_unpickle_NDArrayBacked" and node.args and type(node.args[0]) is Name:
        kind = node.args[0].name
    if kind not in ("Categorical", "StringArray"):
        raise _Malformed("values that are neither an array, categories nor text")
    parts = list(_parts(node.state))
    arrays = [part for part in parts if _role(part) in ("_reconstruct", "_frombuffer")]
    if len(arrays) != 1:
        raise _Malformed(f"a {kind} without its values")
    values = _flat(arrays[0])
    if kind == "StringArray":
        return values
    dtypes = [part.state for part in parts if _role(part) == "CategoricalDtype"]
    if len(dtypes) != 1 or type(dtypes[0]) is not dict:
        raise _Malformed("categories without their type")
    index = _of(dtypes[0].get("categories"), "_new_Index")
    _, state = _sequence(index.args, 2)
    categories = _flat(state.get("data")) if type(state) is dict else []
    if not isinstance(values, np.ndarray) or values.dtype.kind != "i":
        raise _Malformed("categories without codes")
    if len(values) and not -1 <= int(values.min()) <= int(values.max()) < len(categories):
        raise _Malformed("a code without its category")
    return [None if code < 0 else categories[code] for code in values]


def _parts(state: Any) -> Iterator[Made]:
    """The objects in the state of an extension array: a dictionary before pandas 1.3, then a tuple."""
    values = state.values() if type(state) is dict else state if type(state) is tuple else ()
    return (value for value in values if type(value) is Made)


def _flat(node: Any) -> Column:
    """The values of an array or extension array of one dimension."""
    if type(node) is Made and _role(node) == "__pyx_unpickle_NDArrayBacked":
        if not node.args or type(node.args[0]) is not Name or node.args[0].name != "StringArray":
            raise _Malformed("labels that are neither an array nor text")
        return _extension(node)
    if type(node) is Made and _role(node) == "StringArray":
        return _extension(node)
    values, shape = _array(node)
    if len(shape) != 1:
        raise _Malformed(f"an array of {len(shape)} dimensions where one is due")
    return values


def _array(node: Any) -> tuple[Column, tuple[int, ...]]:
    """An array and its shape: numbers as an array of that shape, anything else as a flat list in C order."""
    if type(node) is not Made:
        raise _Malformed("no array where one is due")
    if _role(node) == "_frombuffer":
        if len(node.args) < 4:
            raise _Malformed("an array without its shape")
        raw, dtype, shape, order = node.args[:4]
        return _numeric(raw, _dtype(dtype), _shape(shape), order)
    _, shape, dtype, fortran, raw = _sequence(_of(node, "_reconstruct").state, 5)
    shape, kind = _shape(shape), _dtype(dtype)
    if kind is not None:
        return _numeric(raw, kind, shape, "F" if fortran is True else "C")
    if type(raw) is not list or len(raw) != math.prod(shape):
        raise _Malformed("an array with more or fewer values than its shape says")
    return raw, shape


def _numeric(
    raw: Any, dtype: np.dtype[Any] | None, shape: tuple[int, ...], order: Any
) -> tuple[Column, tuple[int, ...]]:
    if dtype is None or order not in ("C", "F"):
        raise _Malformed("bytes of an array that are no numbers")
    data = _raw(raw, math.prod(shape) * dtype.itemsize)
    return np.frombuffer(data, dtype).reshape(shape, order=order), shape


def _number(node: Any) -> float:
    if type(node) in (int, float) or isinstance(node, np.number):
        return float(node)
    dtype, raw = _sequence(_of(node, "scalar").args, 2)
    values, _ = _numeric(raw, _dtype(dtype), (1,), "C")
    return float(values[0])


def _raw(node: Any, size: int) -> memoryview | bytes:
    """Bytes as protocol 3 and later write them, or as text in Latin-1, which protocol 2 has to."""
    text, encoding = (node, None) if type(node) is memoryview else _sequence(_of(node, "encode").args, 2)
    # Before the text is copied: a hostile pickle may have every row refer to one long text.
    if type(text) not in (memoryview, str) or len(text) != size:
        raise _Malformed("an array with more or fewer bytes than its shape says")
    if isinstance(text, memoryview):
        return text
    if encoding != "latin1":
        raise _Malformed("bytes that are none")
    try:
        return str(text).encode("latin-1")
    except UnicodeEncodeError:
        raise _Malformed("bytes that are none") from None


def _shape(node: Any) -> tuple[int, ...]:
    if type(node) is not tuple or len(node) > 2 or any(type(size) is not int or size < 0 for size in node):
        raise _Malformed("a shape that is none")
    return node


def _dtype(node: Any) -> np.dtype[Any] | None:
    """The type of an array of numbers; None for an array of objects."""
    made = _of(node, "dtype")
    code = made.args[0] if made.args else None
    if type(code) is not str or type(made.state) is not tuple or len(made.state) < 2:
        raise _Malformed("a data type that is none")
    if code in ("O8", "O4", "O"):
        return None
    order = made.state[1]
    if not _NUMERIC.fullmatch(code) or order not in ("<", ">", "|", "="):
        raise _Malformed(f"an array of type {code[:20]!r}")
    dtype: np.dtype[Any] = np.dtype(code).newbyteorder(order)
    return dtype


def _role(node: Made) -> str:
    return node.by.name


def _of(node: Any, name: str) -> Made:
    if type(node) is not Made or node.by.name != name:
        raise _Malformed(f"no {name} where one is due")
    return node


def _sequence(node: Any, length: int | None = None) -> Sequence[Any]:
    if type(node) not in (list, tuple) or length not in (None, len(node)):
        raise _Malformed("a sequence that is not as pandas writes it")
    return node  # type: ignore[no-any-return]
