"""What a pickle of arrays is made of: types and arrays, none of them NumPy's.

NumPy's own functions, given damaged or hostile arguments, allocate without bound or
crash the interpreter; here their arguments are only compared with each other.

Source of the arguments: numpy/numpy, `__reduce__` of arrays, types and scalars.
"""

import dataclasses
import math
import re
from typing import Any, BinaryIO

import numpy as np

from jaxil.demonstrations.readers.pickle_names import Name
from jaxil.demonstrations.readers.recording import FormatError

_MAX_AXES = 32
_NUMBERS = re.compile(r"b1|[iu][1248]|f[248]")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """Bytes that stay in the file.

    Attributes:
      offset: where they begin.
      size: how many they are.
      is_text: they are UTF-8 for characters that stand for a byte each, which is how
        protocol 2 writes bytes.
    """

    offset: int
    size: int
    is_text: bool

    def read(self, file: BinaryIO) -> bytes:
        """Returns the bytes meant: `size`, or of text between half of it and all."""
        file.seek(self.offset)
        content = file.read(self.size)
        if len(content) < self.size:
            raise FormatError("is cut off")
        if not self.is_text:
            return content
        try:
            text = content.decode("utf-8")
            del content  # the three of them may be large
            return text.encode("latin-1")
        except UnicodeError as error:
            raise FormatError("has text in the place of an array's bytes") from error


@dataclasses.dataclass(slots=True, eq=False)
class ElementType:
    """The type of an array's items; `dtype` is None for one that no reader wants."""

    dtype: np.dtype | None


@dataclasses.dataclass(slots=True, eq=False)
class Array:
    """An array whose items may still be in the file.

    Attributes:
      stored_shape: as in NumPy, of the items as they follow each other.
      axes: which of the stored axes the array's first, second, ... is.
      dtype: of numbers, or of Python objects. None for a type that no reader wants,
        and for an array without items.
      data: the items, as many as the shape says; for objects, the list of them.
    """

    stored_shape: tuple[int, ...] = ()
    axes: tuple[int, ...] = ()
    dtype: np.dtype | None = None
    data: Any = None

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.stored_shape[axis] for axis in self.axes)

    @property
    def num_bytes(self) -> int:
        """Of the numbers, all together."""
        if self.dtype is None:
            return 0
        return math.prod(self.stored_shape) * self.dtype.itemsize

    @property
    def has_rows(self) -> bool:
        """Whether each item of the first axis has bytes of its own, in one piece."""
        is_text = isinstance(self.data, Blob) and self.data.is_text
        return self.axes[:1] == (0,) and not is_text

    def row(self, index: int) -> "Array":
        """Returns an item of the first axis; only if the array `has_rows`."""
        axes = tuple(axis - 1 for axis in self.axes[1:])
        row = Array(self.stored_shape[1:], axes, self.dtype)
        start = index * row.num_bytes
        if isinstance(self.data, Blob):
            row.data = Blob(self.data.offset + start, row.num_bytes, is_text=False)
        else:
            row.data = self.data[start : start + row.num_bytes]
        return row

    def read(self, file: BinaryIO) -> np.ndarray:
        """Returns the numbers; they can't be written to."""
        data = self.data.read(file) if isinstance(self.data, Blob) else self.data
        if len(data) != self.num_bytes:
            raise FormatError("has an array that is not as long as it says")
        values = np.frombuffer(data, self.dtype).reshape(self.stored_shape)
        return values.transpose(self.axes)


def called(function: Any, arguments: tuple[Any, ...]) -> Any:
    """Returns what a call stands for, without making it.

    Raises:
      FormatError: no array is written so.
    """
    match function, arguments:
        case Name.RECONSTRUCT, (Name.NDARRAY, (0,), b"b" | "b"):
            return Array()
        case Name.FROM_BUFFER, (data, ElementType(dtype=dtype), shape, "C" | "F" as o):
            return _filled(Array(), shape, dtype, data, is_fortran=o == "F")
        case Name.FROM_BUFFER, (data, ElementType(dtype=dtype), shape, "K", axes):
            return _filled(Array(), shape, dtype, data, axes=axes)
        case Name.DTYPE, (str() | bytes() as code, *_):
            return ElementType(_dtype(_text(code)))
        case Name.SCALAR, (ElementType(dtype=np.dtype() as dtype), bytes() as data):
            if not dtype.hasobject and len(data) == dtype.itemsize:
                return np.frombuffer(data, dtype)[0].item()
        case Name.ENCODE, (str() as text, "latin1" | "latin-1"):
            return text.encode("latin-1")
        case Name.ENCODE, (Blob(is_text=True) as blob, "latin1" | "latin-1"):
            return blob
        case Name.BYTES, (str() | Blob(is_text=True), "latin1" | "latin-1"):
            return called(Name.ENCODE, arguments)
        case Name.BYTES, (bytes() | Blob(is_text=False) as data,):
            return data
        case Name.BYTES, ():
            return b""
    what = function.value if isinstance(function, Name) else "something"
    raise FormatError(
        f"calls {what} in a way that a demonstration needs not: nothing was executed"
    )


def set_state(target: Any, state: Any) -> None:
    """Gives an array its items, or a type its byte order.

    Raises:
      FormatError: they don't fit, or no array is written so.
    """
    match target, state:
        case ElementType(), (_, order, *_):
            if target.dtype is not None and _text(order) in ("<", ">"):
                target.dtype = np.dtype(_text(order) + target.dtype.str[1:])
        case Array(data=None), (_, shape, ElementType(dtype=dtype), order, data):
            _filled(target, shape, dtype, data, is_fortran=bool(order))
        case _:
            raise FormatError(
                "sets the state of something that is no array: nothing was executed"
            )


def _filled(
    array: Array,
    shape: Any,
    dtype: np.dtype | None,
    data: Any,
    *,
    is_fortran: bool = False,
    axes: Any = None,
) -> Array:
    """Returns `array` with its attributes set, if they fit each other.

    Args:
      array: without items as yet.
      shape: of the array, or if axes are given, of its items as they are stored.
      dtype: of the items.
      data: the items.
      is_fortran: the array's first axis is stored last.
      axes: see `Array`; in place of `is_fortran`.

    Raises:
      FormatError: they don't fit.
    """
    if not _are_sizes(shape):
        raise FormatError("has an array of impossible shape")
    axes = tuple(range(len(shape))) if axes is None else axes
    if not _are_sizes(axes) or sorted(axes) != list(range(len(shape))):
        raise FormatError("has an array of impossible axes")
    if is_fortran:
        shape, axes = shape[::-1], axes[::-1]
    array.stored_shape, array.axes, array.data = shape, axes, data
    if dtype is None or 0 in shape:
        return array
    array.dtype = dtype
    if dtype.hasobject:
        fits = isinstance(data, list) and len(data) == math.prod(shape)
    elif isinstance(data, Blob):
        at_least = (data.size + 1) // 2 if data.is_text else data.size
        fits = at_least <= array.num_bytes <= data.size
    else:
        fits = isinstance(data, bytes) and len(data) == array.num_bytes
    if not fits:
        raise FormatError("has an array that is not as long as it says")
    return array


def _are_sizes(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) <= _MAX_AXES
        and all(isinstance(size, int) and size >= 0 for size in value)
    )


def _dtype(code: str) -> np.dtype | None:
    if code in ("O", "O4", "O8"):
        return np.dtype(object)
    return np.dtype(code) if _NUMBERS.fullmatch(code) else None


def _text(value: Any) -> str:
    """Returns a text, which Python 2 wrote as bytes; "" for anything else."""
    if isinstance(value, bytes):
        return value.decode("latin-1")
    return value if isinstance(value, str) else ""
