"""What a pickle of arrays imports; everything else is refused by name.

Source: numpy/numpy, `__reduce__` of arrays, types and scalars, for versions 1 and 2;
Python's own pickles of bytes in protocol 2.
"""

import enum

from jaxil.demonstrations.readers.recording import FormatError


class Name(enum.Enum):
    """What a pickle of arrays may name; none of it is looked up."""

    RECONSTRUCT = "numpy.core.multiarray._reconstruct"
    FROM_BUFFER = "numpy.core.numeric._frombuffer"
    SCALAR = "numpy.core.multiarray.scalar"
    NDARRAY = "numpy.ndarray"
    DTYPE = "numpy.dtype"
    ENCODE = "_codecs.encode"
    BYTES = "builtins.bytes"


_OTHER_NAMES = {
    "builtins.bytearray": Name.BYTES,
    "__builtin__.bytes": Name.BYTES,
    "__builtin__.bytearray": Name.BYTES,
    # NumPy 1.16.0 wrote the name of the compiled module, NumPy 2 renames the package.
    "numpy.core._multiarray_umath._reconstruct": Name.RECONSTRUCT,
    "numpy.core._multiarray_umath.scalar": Name.SCALAR,
    "numpy._core.multiarray._reconstruct": Name.RECONSTRUCT,
    "numpy._core.multiarray.scalar": Name.SCALAR,
    "numpy._core.numeric._frombuffer": Name.FROM_BUFFER,
}
_NAMES = {name.value: name for name in Name} | _OTHER_NAMES


def named(module: str, name: str) -> Name:
    """Returns what a pickle imports.

    Raises:
      FormatError: no array needs it.
    """
    try:
        return _NAMES[f"{module}.{name}"]
    except KeyError:
        raise FormatError(
            f"imports {ascii(f'{module}.{name}')[1:-1][:80]}, which a demonstration "
            "needs not: nothing was executed"
        ) from None
