"""The learner's arrays in a folder, by orbax, with a record and checksums.

learner/         arrays by name, such as actor.params.trunk.kernel
record           JSON: shapes and types of the arrays, and what else is needed
checksums.json   CRC-32 of each file
"""

import errno
import json
import os
import pathlib
import re
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxil.errors import printable
from jaxil.files.untrusted import checksum, read_regular

_FORMAT = 1
_CHECKSUMS = "checksums.json"
_ROOM_BYTES = 2**17  # for what is written beside the arrays


class OtherLearnerError(ValueError):
    """The arrays are those of another learner; the message lists what differs."""


def write(
    folder: pathlib.Path,
    learner_state: Any,
    record: dict,
    arrays: dict[str, np.ndarray],
) -> None:
    """Writes a folder, whose path is absolute and which must not exist.

    The state is a pytree of arrays, typed PRNG keys and None, the record anything that
    JSON can hold. Each further array is written to a file NAME.npy.

    Raises:
      OSError: a file cannot be written.
    """
    import orbax.checkpoint as ocp  # slow to import

    stored, leaves = {}, {}
    for name, leaf in _named_leaves(learner_state):
        key_type = None
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
            key_type = str(jax.random.key_impl(leaf))
            leaf = jax.random.key_data(leaf)
        array = np.asarray(leaf)
        # orbax writes no empty arrays; their shape in the record is enough.
        if array.size:
            stored[name] = array
        leaves[name] = {
            "shape": list(array.shape),
            "dtype": str(array.dtype),
            "key_type": key_type,
        }
    record = {**record, "format": _FORMAT, "leaves": leaves}
    _require_room(folder.parent, sum(array.nbytes for array in stored.values()))
    try:
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            checkpointer.save(
                folder,
                args=ocp.args.Composite(
                    learner=ocp.args.PyTreeSave(stored),
                    record=ocp.args.JsonSave(record),
                ),
            )
    except ValueError as error:  # tensorstore's
        if code := re.search(r"os_error_code='(\d+)'", str(error)):
            raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
        raise OSError(_one_line(error)) from error
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    (folder / _CHECKSUMS).write_text(json.dumps(_checksums(folder, names)))


def read(folder: pathlib.Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Reads the record, and the learner's arrays by name; PRNG keys as raw data.

    Raises:
      ValueError: a file is missing or has changed.
    """
    import orbax.checkpoint as ocp

    try:
        # Before orbax sees them: on a damaged file, its threads print tracebacks, and
        # a change within an array passes unnoticed. Files added since, such as a file
        # manager's, do not matter.
        expected = json.loads(read_regular(folder / _CHECKSUMS))
        if not expected or _checksums(folder, expected) != expected:
            raise ValueError("its files have changed since they were written")
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            restored = checkpointer.restore(
                folder,
                args=ocp.args.Composite(
                    learner=ocp.args.PyTreeRestore(), record=ocp.args.JsonRestore()
                ),
            )
        if restored.record["format"] != _FORMAT:
            raise ValueError("another version of jaxil wrote it")
        arrays = {}
        for name, leaf in restored.record["leaves"].items():
            array = np.asarray(restored.learner.get(name, ()), leaf["dtype"])
            arrays[name] = array.reshape(leaf["shape"])
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise ValueError(_one_line(error)) from error
    return restored.record, arrays


def as_state(abstract_state: Any, record: dict, arrays: dict[str, np.ndarray]) -> Any:
    """Returns the learner state that `write` was given, of what `read` returned.

    Raises:
      OtherLearnerError: names, shapes or dtypes differ from those of `abstract_state`,
        a pytree of the same structure from jax.eval_shape.
    """
    expected = dict(_named_leaves(abstract_state))
    faults = [f"{name} is missing" for name in expected if name not in arrays]
    faults += [f"{name} is unknown" for name in arrays if name not in expected]
    leaves = []
    for name, like in expected.items():
        if name in arrays:
            leaf = _as_leaf(arrays[name], record["leaves"][name]["key_type"])
            if _kind(leaf) != _kind(like):
                faults.append(f"{name} is {_kind(leaf)}, expected {_kind(like)}")
            leaves.append(leaf)
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise OtherLearnerError("; ".join(printable(f, 200) for f in faults[:5]) + more)
    return jax.tree.unflatten(jax.tree.structure(abstract_state), leaves)


def _require_room(folder: pathlib.Path, num_bytes: int) -> None:
    """Raises OSError if the disk is full: orbax's threads would print tracebacks."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, num_bytes + _ROOM_BYTES)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Lists the leaves with a name each, like actor.params.trunk.kernel."""
    return [
        (jax.tree_util.keystr(path, simple=True, separator="."), leaf)
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    ]


def _as_leaf(array: np.ndarray, key_type: str | None) -> jax.Array:
    if key_type is not None:
        return jax.random.wrap_key_data(jnp.asarray(array), impl=key_type)
    # A copy, because the learner donates its state: jax must own this memory.
    return jnp.array(array, copy=True)


def _kind(leaf: Any) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}"


def _checksums(folder: pathlib.Path, names: list[str]) -> dict[str, int]:
    return {name: checksum(folder / name) for name in names}


def _one_line(error: Exception) -> str:
    first = next(iter(str(error).strip().splitlines()), "")
    name = type(error).__name__
    return f"{name}: {printable(first, 160)}" if first else name
