"""Interprets a pickle without ever importing, calling or building what it asks for.

What a pickle would call becomes an inert `Made`: the name, the arguments and the state, for the caller to read
as data. The standard library's unpickler is not used, even with its `find_class` closed: a small file
makes it take memory without limit (a memo index of 2^31) or time without end (nested tuples as the keys of
a dictionary, whose hashes double at each level).

Knows the binary opcodes that protocols 2 to 5 write (PEP 307, 3154 and 574; `pickletools` describes each).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from uwb_mitigation.errors import RecordingError

PROTOCOLS = (2, 3, 4, 5)

MAX_OPCODES = 1 << 24
"""Ceiling on the opcodes of one pickle: each makes at most one value."""

MAX_OBJECTS = 1 << 22
"""Ceiling on values other than numbers, which take up to some 200 bytes each, and on remembered values."""

_MAX_INTEGER_BYTES = 16
_MAX_NAME = 512
_MAX_SHOWN = 80

_U16 = struct.Struct("<H")
_I32 = struct.Struct("<i")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_F64 = struct.Struct(">d")


@dataclass(frozen=True, slots=True)
class Name:
    """What a pickle refers to by its module and name; never looked up."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class Made:
    """What a pickle would have made by calling `by` with `args`, and given `state`.

    Attributes:
        by: the callable or class.
        args: what it would have been called with.
        state: what it would have been built from; None where there is none.
    """

    __slots__ = ("args", "by", "state")

    def __init__(self, by: Name, args: tuple[Any, ...]) -> None:
        self.by = by
        self.args = args
        self.state: Any = None


def interpret(data: bytes, allowed: Collection[Name], where: str) -> Any:
    """The value of a pickle, of None, bool, int, float, str, memoryview (for bytes), tuple, list, dict
    with keys of str, `Name` and `Made`. The value may contain itself.

    Args:
        data: the pickle.
        allowed: what it may refer to.
        where: the place of the pickle, for errors.

    Raises:
        RecordingError: the pickle refers to anything else, is damaged, has opcodes that no protocol from 2
            to 5 writes for plain data, or is beyond a ceiling; says which, and at which byte.
    """
    return _Machine(data, frozenset(allowed), where).run()


class _Refused(Exception):
    """What is wrong with the pickle and, optionally, what would be valid; without the place."""


class _Machine:
    """The stack, the marks on it and the memo of one pickle."""

    def __init__(self, data: bytes, allowed: frozenset[Name], where: str) -> None:
        self._data = data
        self._view = memoryview(data)
        self._at = 0
        self._allowed = allowed
        self._where = where
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._objects = 0

    def run(self) -> Any:
        opcode_at = 0
        try:
            for _ in range(MAX_OPCODES):
                opcode_at = self._at
                opcode = self._data[opcode_at]
                self._at = opcode_at + 1
                if opcode == _STOP:
                    return self._pop()
                handler = _HANDLERS[opcode]
                if handler is None:
                    raise _Refused(f"opcode 0x{opcode:02x}", "a pickle of protocol 2, 3, 4 or 5")
                handler(self)
            raise _Refused(f"more than {MAX_OPCODES} opcodes")
        except _Refused as error:
            raise self._error(opcode_at, *error.args) from None
        except (IndexError, struct.error):
            raise self._error(len(self._data), "the pickle ends early", "the whole file") from None
        except UnicodeDecodeError:
            raise self._error(opcode_at, "text that is not UTF-8") from None

    def _error(self, at: int, what: str, valid: str = "") -> RecordingError:
        return RecordingError(what, where=f"{self._where}, byte {at}", valid=valid)

    # What opcodes read after themselves.

    def _number(self, layout: struct.Struct) -> Any:
        (value,) = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return value

    def _byte(self) -> int:
        value = self._data[self._at]
        self._at += 1
        return value

    def _bytes(self, size: int) -> memoryview:
        end = self._at + size
        if end > len(self._data):
            raise IndexError
        taken = self._view[self._at : end]
        self._at = end
        return taken

    def _line(self) -> str:
        end = self._data.find(b"\n", self._at, self._at + _MAX_NAME)
        if end < 0:
            raise _Refused("a name without an end")
        line = str(self._bytes(end - self._at), "utf-8")
        self._at = end + 1
        return line

    # The stack.

    def _pop(self) -> Any:
        stack = self._stack
        if len(stack) <= (self._marks[-1] if self._marks else 0):
            raise _Refused("a value is taken from an empty stack")
        return stack.pop()

    def _pop_to_mark(self) -> list[Any]:
        if not self._marks:
            raise _Refused("values are taken to a mark that is not there")
        start = self._marks.pop()
        values = self._stack[start:]
        del self._stack[start:]
        return values

    def _top(self, kind: type[Any], what: str) -> Any:
        if not self._stack or type(self._stack[-1]) is not kind:
            raise _Refused(f"{what} where there is none")
        return self._stack[-1]

    def _push_object(self, value: Any) -> None:
        self._objects += 1
        if self._objects > MAX_OBJECTS:
            raise _Refused(f"more than {MAX_OBJECTS} values that are no numbers")
        self._stack.append(value)

    # Opcodes, in the order of `pickletools`.

    def proto(self) -> None:
        protocol = self._byte()
        if protocol not in PROTOCOLS:
            raise _Refused(f"pickle protocol {protocol}", "2, 3, 4 or 5")

    def frame(self) -> None:
        self._number(_U64)  # only tells a reader of streams how much to fetch

    def binint(self) -> None:
        self._stack.append(self._number(_I32))

    def binint1(self) -> None:
        self._stack.append(self._byte())

    def binint2(self) -> None:
        self._stack.append(self._number(_U16))

    def long1(self) -> None:
        size = self._byte()
        if size > _MAX_INTEGER_BYTES:
            raise _Refused(f"an integer of {size} bytes", f"at most {_MAX_INTEGER_BYTES}")
        self._stack.append(int.from_bytes(self._bytes(size), "little", signed=True))

    def binfloat(self) -> None:
        at = self._at
        self._stack.append(_F64.unpack_from(self._data, at)[0])
        self._at = at + 8

    def none(self) -> None:
        self._stack.append(None)

    def newtrue(self) -> None:
        self._stack.append(True)

    def newfalse(self) -> None:
        self._stack.append(False)

    def short_binbytes(self) -> None:
        self._push_object(self._bytes(self._byte()))

    def binbytes(self) -> None:
        self._push_object(self._bytes(self._number(_U32)))

    def binbytes8(self) -> None:
        self._push_object(self._bytes(self._number(_U64)))

    def short_binunicode(self) -> None:
        self._push_text(self._byte())

    def binunicode(self) -> None:
        self._push_text(self._number(_U32))

    def binunicode8(self) -> None:
        self._push_text(self._number(_U64))

    def _push_text(self, size: int) -> None:
        # surrogatepass is what pickle itself writes text with
        self._push_object(str(self._bytes(size), "utf-8", "surrogatepass"))

    def empty_list(self) -> None:
        self._push_object([])

    def empty_dict(self) -> None:
        self._push_object({})

    def empty_tuple(self) -> None:
        self._stack.append(())

    def mark(self) -> None:
        self._marks.append(len(self._stack))

    def append(self) -> None:
        value = self._pop()
        self._top(list, "a list is added to").append(value)

    def appends(self) -> None:
        values = self._pop_to_mark()
        self._top(list, "a list is added to").extend(values)

    def tuple_to_mark(self) -> None:
        self._push_object(tuple(self._pop_to_mark()))

    def tuple1(self) -> None:
        self._push_object((self._pop(),))

    def tuple2(self) -> None:
        second, first = self._pop(), self._pop()
        self._push_object((first, second))

    def tuple3(self) -> None:
        third, second, first = self._pop(), self._pop(), self._pop()
        self._push_object((first, second, third))

    def setitem(self) -> None:
        value, key = self._pop(), self._pop()
        self._set_items([key, value])

    def setitems(self) -> None:
        self._set_items(self._pop_to_mark())

    def _set_items(self, values: list[Any]) -> None:
        target = self._top(dict, "a dictionary is added to")
        if len(values) % 2:
            raise _Refused("a key of a dictionary without its value")
        for key, value in zip(values[0::2], values[1::2], strict=True):
            # Keys of other types have hashes that take a hostile pickle's own time to compute.
            if type(key) is not str:
                raise _Refused(f"a key of a dictionary is a {type(key).__name__}", "str")
            target[key] = value

    def binput(self) -> None:
        self._remember(self._byte())

    def long_binput(self) -> None:
        self._remember(self._number(_U32))

    def memoize(self) -> None:
        self._remember(len(self._memo))

    def _remember(self, index: int) -> None:
        if not self._stack:
            raise _Refused("nothing to remember")
        if len(self._memo) >= MAX_OBJECTS:
            raise _Refused(f"more than {MAX_OBJECTS} remembered values")
        self._memo[index] = self._stack[-1]

    def binget(self) -> None:
        self._recall(self._byte())

    def long_binget(self) -> None:
        self._recall(self._number(_U32))

    def _recall(self, index: int) -> None:
        try:
            self._stack.append(self._memo[index])
        except KeyError:
            raise _Refused(f"value {index} is recalled before it is there") from None

    def global_name(self) -> None:
        module = self._line()
        self._push_name(module, self._line())

    def stack_global(self) -> None:
        name, module = self._pop(), self._pop()
        if type(name) is not str or type(module) is not str:
            raise _Refused("a name that is not text")
        self._push_name(module, name)

    def _push_name(self, module: str, name: str) -> None:
        wanted = Name(module, name)
        if wanted not in self._allowed:
            raise _Refused(
                f"refers to {str(wanted)[:_MAX_SHOWN]!r}", "only arrays and frames; nothing was run"
            )
        self._stack.append(wanted)

    def reduce(self) -> None:
        args, by = self._pop(), self._pop()
        if type(by) is not Name or type(args) is not tuple:
            raise _Refused("a call of what is no name, or without arguments")
        self._push_object(Made(by, args))

    def build(self) -> None:
        state = self._pop()
        made = self._top(Made, "an object is given its state")
        if made.state is not None:
            raise _Refused("an object is given its state twice")
        made.state = state


_STOP = ord(".")

_HANDLERS: list[Callable[[_Machine], None] | None] = [None] * 256
for _opcode, _handler in {
    b"\x80": _Machine.proto,
    b"\x95": _Machine.frame,
    b"J": _Machine.binint,
    b"K": _Machine.binint1,
    b"M": _Machine.binint2,
    b"\x8a": _Machine.long1,
    b"G": _Machine.binfloat,
    b"N": _Machine.none,
    b"\x88": _Machine.newtrue,
    b"\x89": _Machine.newfalse,
    b"C": _Machine.short_binbytes,
    b"B": _Machine.binbytes,
    b"\x8e": _Machine.binbytes8,
    b"\x96": _Machine.binbytes8,  # a bytearray, written alike
    b"\x8c": _Machine.short_binunicode,
    b"X": _Machine.binunicode,
    b"\x8d": _Machine.binunicode8,
    b"]": _Machine.empty_list,
    b"}": _Machine.empty_dict,
    b")": _Machine.empty_tuple,
    b"(": _Machine.mark,
    b"a": _Machine.append,
    b"e": _Machine.appends,
    b"t": _Machine.tuple_to_mark,
    b"\x85": _Machine.tuple1,
    b"\x86": _Machine.tuple2,
    b"\x87": _Machine.tuple3,
    b"s": _Machine.setitem,
    b"u": _Machine.setitems,
    b"q": _Machine.binput,
    b"r": _Machine.long_binput,
    b"\x94": _Machine.memoize,
    b"h": _Machine.binget,
    b"j": _Machine.long_binget,
    b"c": _Machine.global_name,
    b"\x93": _Machine.stack_global,
    b"R": _Machine.reduce,
    b"\x81": _Machine.reduce,  # makes an object of a class, written alike
    b"b": _Machine.build,
}.items():
    _HANDLERS[_opcode[0]] = _handler
