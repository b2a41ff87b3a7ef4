"""Locks that keep other processes away from a folder."""

import contextlib
import errno
import fcntl
import json
import os
import pathlib
import platform
import time
from collections.abc import Iterator

# File systems that have no locks say so in one of these ways (NFS, Lustre).
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class InUseError(Exception):
    """Another process holds the lock; the message says which, if that is known."""


@contextlib.contextmanager
def locked(path: pathlib.Path) -> Iterator[None]:
    """Holds the lock on a file, which is created if it is missing.

    Where the file system has no locks, PATH.owner stands in: a file that only one
    process can create, with host, process id and time. An owner that has ended on this
    host is replaced.

    Raises:
      InUseError: another process holds it.
      OSError: the file cannot be written.
    """
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InUseError("in use by another process") from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            owner = path.with_name(f"{path.name}.owner")
            _own(owner)
            try:
                yield
            finally:
                owner.unlink(missing_ok=True)
            return
        yield


def is_locked(path: pathlib.Path) -> bool:
    """Returns whether another process holds the lock on a file."""
    try:
        with path.open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return _owner(path.with_name(f"{path.name}.owner")) is not None
        return not isinstance(error, FileNotFoundError)
    return False


def _own(path: pathlib.Path) -> None:
    """Creates the file of an owner."""
    if _owner(path) is None:
        path.unlink(missing_ok=True)
    try:
        with path.open("x") as file:
            json.dump([platform.node(), os.getpid(), time.strftime("%F %T")], file)
    except FileExistsError as error:
        raise InUseError(
            f"in use by {_owner(path) or 'another process'} (if that has ended, "
            f"delete {path})"
        ) from error


def _owner(path: pathlib.Path) -> str | None:
    """Returns who owns a file, in words; None if no process does any more."""
    try:
        host, process, since = json.loads(path.read_text())
        if host == platform.node():
            os.kill(int(process), 0)
    except (FileNotFoundError, ProcessLookupError):
        return None
    except PermissionError:  # it runs, and belongs to someone else
        pass
    except (OSError, ValueError, TypeError, OverflowError, RecursionError):
        return "an unknown process"
    return f"process {process} on {host} since {since}"
