"""File locks between processes."""

import contextlib
import errno
import fcntl
import json
import os
import pathlib
import platform
import threading
import time
from collections.abc import Iterator

from jaxil.errors import printable
from jaxil.files.untrusted import read_regular

# Reported by file systems without locks (some NFS and Lustre mounts).
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
_HEARTBEAT_SECONDS = 60.0
# An owner elsewhere counts as dead after so long without a heartbeat; the clocks of
# machines that share a file system must differ by less.
_DEAD_SECONDS = 600.0


class InUseError(Exception):
    """Another process holds the lock."""


@contextlib.contextmanager
def locked(path: pathlib.Path) -> Iterator[None]:
    """Holds the lock on a file, creating the file if it is missing.

    On a file system without locks, PATH.owner stands in: a file, created exclusively,
    that names the process and is touched every minute. It is taken over once that
    process has ended or, if it is of another machine, boot or container, once the file
    has not been touched for ten minutes.

    Raises:
      InUseError: another process holds the lock.
    """
    # Not `open`, which would wait for a reader if someone has put a pipe there.
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK
    with os.fdopen(os.open(path, flags, 0o666), "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InUseError("in use by another process") from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            with _owned(path.with_name(f"{path.name}.owner")):
                yield
            return
        yield


def is_locked(path: pathlib.Path) -> bool:
    """Returns whether another process holds the lock on a file.

    One that exists but cannot be opened counts as locked.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK)) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return _owner(path.with_name(f"{path.name}.owner")) is not None
        return not isinstance(error, FileNotFoundError)
    return False


@contextlib.contextmanager
def _owned(path: pathlib.Path) -> Iterator[None]:
    since = time.strftime("%F %T")
    owner = json.dumps([*_machine(), os.getpid(), _start(os.getpid()), since])
    try:
        _claim(path, owner)
    except FileExistsError as error:
        raise InUseError(
            f"in use by {_owner(path) or 'another process'} (if that has ended, "
            f"delete {path})"
        ) from error
    ended = threading.Event()

    def touch() -> None:
        while not ended.wait(_HEARTBEAT_SECONDS):
            with contextlib.suppress(OSError):
                os.utime(path)

    threading.Thread(target=touch, daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        with contextlib.suppress(OSError):  # it may have been taken over
            if path.read_text() == owner:
                path.unlink()


def _claim(path: pathlib.Path, owner: str) -> None:
    """Creates the owner's file, in place of one whose owner has ended.

    One process at a time: otherwise two could find the same owner dead, and the second
    would remove the first one's file.

    Raises:
      FileExistsError: another process owns it or is claiming it.
    """
    claim = path.with_name(f"{path.name}.claim")
    with contextlib.suppress(FileNotFoundError):
        if time.time() - claim.stat().st_mtime > _DEAD_SECONDS:  # killed in between
            claim.unlink()
    claim.touch(exist_ok=False)
    try:
        if _owner(path) is None:
            path.unlink(missing_ok=True)
        with path.open("x") as file:
            file.write(owner)
    finally:
        claim.unlink(missing_ok=True)


def _owner(path: pathlib.Path) -> str | None:
    """Returns a description of the owner; None if there is none or it has ended."""
    is_old = False
    try:
        is_old = time.time() - path.stat().st_mtime > _DEAD_SECONDS
        *machine, process, start, since = json.loads(read_regular(path))
        if machine == _machine():
            is_old = _start(int(process)) != start
        name = f"process {process} on {machine[0]} since {since}"
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, IndexError, RecursionError):
        name = "an unknown process"
        if not path.is_file():
            return name
    return None if is_old else printable(name, 200)


def _machine() -> list[str]:
    """Returns what identifies this machine, its last boot and the container."""
    boot = pathlib.Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return [platform.node(), boot, str(pathlib.Path("/proc/self/ns/pid").readlink())]


def _start(process: int) -> str | None:
    """Returns when a process began, in clock ticks; None if it has ended."""
    try:
        stat = pathlib.Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return None
    # After the name in brackets: the state, 18 numbers, and the start.
    state, *numbers = stat.rpartition(")")[2].split()
    return None if state in "ZX" else numbers[18]
