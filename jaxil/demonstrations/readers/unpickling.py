"""Reading pickles of NumPy arrays, executing nothing of what they say.

A pickle is a program for a stack machine, and may call any function. This machine knows
the few instructions that lists, numbers and arrays are written with, calls nothing, and
leaves long contents in the file until they are asked for.

Source of the instructions: the documentation in Python's `pickletools`.
"""

import io
import pickle  # for the names of the instructions alone
import struct
from collections.abc import Callable
from typing import Any, BinaryIO

from jaxil.demonstrations.readers.pickle_names import named
from jaxil.demonstrations.readers.pickle_values import Blob, called, set_state
from jaxil.demonstrations.readers.recording import FormatError

PROTOCOLS = range(2, 6)
# Some 18000 steps if each is stored as arrays of its own; at most 3 seconds.
_MAX_INSTRUCTIONS = 1_500_000
_MAX_INLINE_BYTES = 1024


def read_pickle(file: BinaryIO) -> Any:
    """Reads a pickle of lists, tuples, texts, numbers and arrays.

    Args:
      file: at its beginning; of protocol 2 to 5, with all buffers within.

    Returns:
      Lists, tuples, numbers, None, texts and bytes; `Array` for arrays, and `Blob` for
      long texts and bytes. Dictionaries come out empty: no demonstration is in one.

    Raises:
      FormatError: it is damaged, or needs anything else; nothing was executed.
    """
    machine = _Machine(file)
    try:
        return machine.run()
    except FormatError:
        raise
    except (
        IndexError,  # nothing on the stack
        KeyError,  # nor in the memo
        TypeError,
        AttributeError,
        ValueError,
    ) as error:
        raise FormatError(f"is damaged before byte {file.tell()}") from error


class _Machine:
    def __init__(self, file: BinaryIO):
        self._file = file
        self._size = file.seek(0, io.SEEK_END)
        self._stack: list[Any] = []
        self._outer_stacks: list[list[Any]] = []  # one for each mark
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        self._file.seek(0)
        start = self._file.read(2)
        if len(start) < 2 or start[:1] != pickle.PROTO or start[1] not in PROTOCOLS:
            raise FormatError("is no pickle of protocol 2 to 5")
        for _ in range(_MAX_INSTRUCTIONS):
            code = self.take(1)
            if code == pickle.STOP:
                return self._stack.pop()
            instruction = _INSTRUCTIONS.get(code)
            if instruction is None:
                raise FormatError(
                    f"holds the instruction {code!r}, which a demonstration needs not: "
                    "nothing was executed"
                )
            instruction(self)
        raise FormatError(
            f"is a pickle of more than {_MAX_INSTRUCTIONS} instructions; store each "
            "episode as one array"
        )

    # --- what follows an instruction --------------------------------------------------

    def take(self, num_bytes: int) -> bytes:
        content = self._file.read(num_bytes)
        if len(content) < num_bytes:
            raise FormatError("is cut off")
        return content

    def number(self, layout: str) -> Any:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))[0]

    def long(self) -> int:
        return int.from_bytes(self.take(self.number("<B")), "little", signed=True)

    def string(self, length_layout: str, *, is_text: bool) -> str | bytes | Blob:
        size = self.number(length_layout)
        offset = self._file.tell()
        if size > self._size - offset:
            raise FormatError("is cut off")
        if size > _MAX_INLINE_BYTES:
            self._file.seek(size, io.SEEK_CUR)
            return Blob(offset, size, is_text)
        content = self.take(size)
        return content.decode("utf-8") if is_text else content

    def line(self) -> str:
        line = self._file.readline(_MAX_INLINE_BYTES)
        if not line.endswith(b"\n") and len(line) < _MAX_INLINE_BYTES:
            raise FormatError("is cut off")
        return line.decode().removesuffix("\n")

    # --- instructions -----------------------------------------------------------------

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def pop(self, count: int) -> list[Any]:
        if count > len(self._stack):
            raise IndexError
        items = self._stack[-count:]
        del self._stack[-count:]
        return items

    def mark(self) -> None:
        self._outer_stacks.append(self._stack)
        self._stack = []

    def pop_to_mark(self) -> list[Any]:
        items, self._stack = self._stack, self._outer_stacks.pop()
        return items

    def append(self, items: list[Any]) -> None:
        if not isinstance(self._stack[-1], list):
            raise TypeError
        self._stack[-1].extend(items)

    def put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def memoise(self) -> None:
        self.put(len(self._memo))

    def get(self, index: int) -> None:
        self.push(self._memo[index])

    def import_from_stack(self) -> None:
        module, name = self.pop(2)
        if not isinstance(module, str) or not isinstance(name, str):
            raise TypeError
        self.push(named(module, name))

    def call(self) -> None:
        function, arguments = self.pop(2)
        if not isinstance(arguments, tuple):
            raise TypeError
        self.push(called(function, arguments))

    def build(self) -> None:
        (state,) = self.pop(1)
        set_state(self._stack[-1], state)

    def skip_frame(self) -> None:
        """Frames only tell how much to read at once."""
        if self.number("<Q") > self._size - self._file.tell():
            raise FormatError("is cut off")

    def refuse_instance(self) -> None:
        named(self.line(), self.line())
        raise FormatError("makes an object that is no array: nothing was executed")

    def refuse_buffer(self) -> None:
        raise FormatError("is a pickle whose arrays are kept elsewhere (in buffers)")


_INSTRUCTIONS: dict[bytes, Callable[[_Machine], Any]] = {
    pickle.PROTO: lambda machine: machine.take(1),
    pickle.FRAME: _Machine.skip_frame,
    pickle.NONE: lambda machine: machine.push(None),
    pickle.NEWTRUE: lambda machine: machine.push(True),
    pickle.NEWFALSE: lambda machine: machine.push(False),
    pickle.BININT: lambda machine: machine.push(machine.number("<i")),
    pickle.BININT1: lambda machine: machine.push(machine.number("<B")),
    pickle.BININT2: lambda machine: machine.push(machine.number("<H")),
    pickle.LONG1: lambda machine: machine.push(machine.long()),
    pickle.BINFLOAT: lambda machine: machine.push(machine.number(">d")),
    **{
        code: lambda machine, length=length, is_text=is_text: machine.push(
            machine.string(length, is_text=is_text)
        )
        for code, length, is_text in (
            (pickle.SHORT_BINSTRING, "<B", False),
            (pickle.BINSTRING, "<I", False),
            (pickle.SHORT_BINBYTES, "<B", False),
            (pickle.BINBYTES, "<I", False),
            (pickle.BINBYTES8, "<Q", False),
            (pickle.BYTEARRAY8, "<Q", False),
            (pickle.SHORT_BINUNICODE, "<B", True),
            (pickle.BINUNICODE, "<I", True),
            (pickle.BINUNICODE8, "<Q", True),
        )
    },
    pickle.EMPTY_LIST: lambda machine: machine.push([]),
    pickle.EMPTY_TUPLE: lambda machine: machine.push(()),
    pickle.EMPTY_DICT: lambda machine: machine.push({}),
    pickle.TUPLE1: lambda machine: machine.push(tuple(machine.pop(1))),
    pickle.TUPLE2: lambda machine: machine.push(tuple(machine.pop(2))),
    pickle.TUPLE3: lambda machine: machine.push(tuple(machine.pop(3))),
    pickle.MARK: _Machine.mark,
    pickle.TUPLE: lambda machine: machine.push(tuple(machine.pop_to_mark())),
    pickle.APPEND: lambda machine: machine.append(machine.pop(1)),
    pickle.APPENDS: lambda machine: machine.append(machine.pop_to_mark()),
    pickle.SETITEM: lambda machine: machine.pop(2),
    pickle.SETITEMS: _Machine.pop_to_mark,
    pickle.BINPUT: lambda machine: machine.put(machine.number("<B")),
    pickle.LONG_BINPUT: lambda machine: machine.put(machine.number("<I")),
    pickle.MEMOIZE: _Machine.memoise,
    pickle.BINGET: lambda machine: machine.get(machine.number("<B")),
    pickle.LONG_BINGET: lambda machine: machine.get(machine.number("<I")),
    pickle.GLOBAL: lambda machine: machine.push(named(machine.line(), machine.line())),
    pickle.STACK_GLOBAL: _Machine.import_from_stack,
    pickle.REDUCE: _Machine.call,
    pickle.BUILD: _Machine.build,
    # Refused with a reason of their own.
    pickle.INST: _Machine.refuse_instance,
    pickle.NEXT_BUFFER: _Machine.refuse_buffer,
    pickle.READONLY_BUFFER: _Machine.refuse_buffer,
}
