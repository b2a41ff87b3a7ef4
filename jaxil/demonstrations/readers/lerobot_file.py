"""The program that reads a LeRobot dataset's Parquet files, in a process of its own.

A Parquet file of a few bytes may truly mean more numbers than fit into the memory; here
that memory is bounded. It opens no other file, however the format may refer to one.
"""

import itertools
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from jaxil.demonstrations.readers import messages, pictures
from jaxil.demonstrations.readers.messages import Message
from jaxil.demonstrations.readers.recording import FormatError

_BATCH_ROWS = 256  # decoded at a time


def read(
    path: pathlib.Path,
    *,
    max_bytes: int,
    columns: Sequence[str],
    image: str | None = None,
    split: str | None = None,
) -> Iterator[Message]:
    """Yields the columns of a file, in pieces.

    Args:
      path: the file.
      max_bytes: of one piece.
      columns: names of those with numbers, one or equally many in a row.
      image: name of a column of pictures, sent as "frames", uint8 [N, H, W, 3].
      split: name of an integer column; each run of one value becomes a piece, with
        "value" among its facts. None for a single piece.
    """
    # Columns need `compute`, and would load it when files can't be opened any more.
    from pyarrow import compute, parquet  # noqa: F401

    pictures.prepare()
    with path.open("rb") as opened, parquet.ParquetFile(opened) as file:
        messages.open_no_more_files()
        wanted = [*columns, *([split] if split else []), *([image] if image else [])]
        missing = [name for name in wanted if name not in file.schema_arrow.names]
        if missing:
            raise FormatError(f"has no column {', '.join(missing)} in {path.name}")
        batches = file.iter_batches(_BATCH_ROWS, columns=wanted, use_threads=False)
        for value, piece in _pieces(batches, split, max_bytes):
            arrays = {name: _numbers_of(name, piece[name]) for name in columns}
            if image:
                files = _pictures_of(piece[image])
                arrays["frames"] = pictures.decode_pictures(files, max_bytes=max_bytes)
            yield Message({"value": value}, arrays)


def _pieces(
    batches: Iterable[Any], split: str | None, max_bytes: int
) -> Iterator[tuple[int | None, Any]]:
    """Yields tables of rows that belong together, each with the value they share."""
    import pyarrow

    value, parts, num_bytes = None, [], 0
    for batch in batches:
        values = None if split is None else _numbers_of(split, batch.column(split))
        for start, stop in _runs(values, batch.num_rows):
            now = None if values is None else int(values[start])
            if parts and now != value:
                yield value, pyarrow.Table.from_batches(parts)
                parts, num_bytes = [], 0
            value = now
            parts.append(batch.slice(start, stop - start))
            num_bytes += parts[-1].nbytes
            if num_bytes > max_bytes:
                raise FormatError(
                    f"has rows of {num_bytes} bytes that belong together, more than "
                    f"the {max_bytes} that are accepted"
                )
    if parts:
        yield value, pyarrow.Table.from_batches(parts)


def _runs(values: np.ndarray | None, num_rows: int) -> Iterator[tuple[int, int]]:
    """Yields where runs of equal values start and stop."""
    changes = [] if values is None else (np.flatnonzero(np.diff(values)) + 1).tolist()
    for start, stop in itertools.pairwise([0, *changes, num_rows]):
        if stop > start:
            yield start, stop


def _numbers_of(name: str, column: Any) -> np.ndarray:
    """Returns a column as int64 or float64, [N] or [N, A]."""
    import pyarrow
    from pyarrow import types

    if isinstance(column, pyarrow.ChunkedArray):
        column = column.combine_chunks()
    num_rows = len(column)
    absent = FormatError(f"has rows without a number in {name}")
    if column.null_count:
        raise absent
    lists = (types.is_list, types.is_large_list, types.is_fixed_size_list)
    is_list = any(is_one(column.type) for is_one in lists)
    if is_list:
        if len(set(column.value_lengths().to_pylist())) > 1:
            raise FormatError(f"has rows of unequal lengths in {name}")
        column = column.flatten()
    if column.null_count:
        raise absent
    if types.is_integer(column.type) or types.is_boolean(column.type):
        dtype = np.int64
    elif types.is_floating(column.type):
        dtype = np.float64
    else:
        raise FormatError(f"has {name} of type {column.type}, where numbers belong")
    values = column.to_numpy(zero_copy_only=False).astype(dtype)
    return values.reshape(num_rows, -1) if is_list and num_rows else values


def _pictures_of(column: Any) -> list[bytes]:
    """Returns the bytes of a column's pictures."""
    from pyarrow import types

    if not types.is_struct(column.type) or column.type.get_field_index("bytes") < 0:
        raise FormatError(f"has pictures of type {column.type}")
    contents = column.combine_chunks().field("bytes").to_pylist()
    if not all(isinstance(content, bytes) for content in contents):
        raise FormatError("keeps its pictures in other files")
    return contents


if __name__ == "__main__":
    messages.serve(read)
