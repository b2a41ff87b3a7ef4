"""File locks between processes."""

import contextlib
import errno
import fcntl
import json
import os
import pathlib
import platform
import time
from collections.abc import Iterator

# Reported by file systems without locks (some NFS and Lustre mounts).
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class InUseError(Exception):
    """Another process holds the lock."""


@contextlib.contextmanager
def locked(path: pathlib.Path) -> Iterator[None]:
    """Holds the lock on a file, creating the file if it is missing.

    Without file-system locks, PATH.owner replaces the lock: a file, created
    exclusively, of host, process id and time. It is taken over if its process has ended
    on this host. Raises InUseError if another process holds the lock.
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
    """Describes the owner; None if there is none, or if it has ended."""
    try:
        host, process, since = json.loads(path.read_text())
        if host == platform.node():
            os.kill(int(process), 0)
    except (FileNotFoundError, ProcessLookupError):
        return None
    except PermissionError:  # running, as another user
        pass
    except (OSError, ValueError, TypeError, OverflowError, RecursionError):
        return "an unknown process"
    return f"process {process} on {host} since {since}"
