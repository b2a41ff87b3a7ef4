"""Locks, also on file systems that have none."""

import concurrent.futures
import errno
import fcntl
import json
import os
import subprocess
import sys
import threading
import time

import pytest

from jaxil.files import locking
from jaxil.files.locking import InUseError, is_locked, locked


@pytest.fixture(params=[None, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def lock(request, tmp_path, monkeypatch):
    """A path, where flock works or says that it cannot."""
    if request.param is not None:
        _refuse_locks(monkeypatch, request.param)
    return tmp_path / "lock"


def _refuse_locks(monkeypatch, code=errno.ENOLCK):
    def refuse(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_one_holds_it_at_a_time(lock):
    assert not is_locked(lock)
    with locked(lock):
        assert is_locked(lock)
        with pytest.raises(InUseError, match="in use by"), locked(lock):
            pass
        assert is_locked(lock)
    assert not is_locked(lock)
    with locked(lock):
        pass


def test_another_fault_of_the_lock_is_passed_on(tmp_path, monkeypatch):
    _refuse_locks(monkeypatch, errno.EIO)
    with pytest.raises(OSError, match="Input/output"), locked(tmp_path / "lock"):
        pass


HOLD = """
import errno, fcntl, pathlib, sys
def refuse(*_):
    raise OSError(errno.ENOLCK, "no locks available")
fcntl.flock = refuse
from jaxil.files.locking import locked
with locked(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def left(tmp_path, monkeypatch):
    """A lock whose owner was killed, on a file system without locks."""
    _refuse_locks(monkeypatch)
    path = tmp_path / "lock"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        assert is_locked(path)
        process.kill()
    assert (tmp_path / "lock.owner").exists()
    return path


def _change_owner(path, place: int, value) -> None:
    owner = path.with_name("lock.owner")
    content = json.loads(owner.read_text())
    content[place] = value
    owner.write_text(json.dumps(content))


def test_an_owner_that_was_killed_is_replaced_at_once(left):
    assert not is_locked(left)
    with locked(left):
        assert is_locked(left)
    assert not left.with_name("lock.owner").exists()


def test_of_several_that_find_an_owner_dead_one_replaces_it(left):
    content = left.with_name("lock.owner").read_text()
    everyone = threading.Barrier(8)

    def hold() -> int:
        everyone.wait(60)
        try:
            with locked(left):
                everyone.wait(60)
        except InUseError:
            everyone.wait(60)
            return 0
        return 1

    with concurrent.futures.ThreadPoolExecutor(everyone.parties) as threads:
        for _ in range(30):
            left.with_name("lock.owner").write_text(content)
            holding = [threads.submit(hold) for _ in range(everyone.parties)]
            assert sum(each.result(60) for each in holding) == 1


def test_a_claim_that_was_killed_counts_for_ten_minutes(tmp_path, monkeypatch):
    _refuse_locks(monkeypatch)
    claim = tmp_path / "lock.owner.claim"
    claim.touch()
    with pytest.raises(InUseError, match="another process"), locked(tmp_path / "lock"):
        pass
    os.utime(claim, (0, 0))
    with locked(tmp_path / "lock"):
        assert not claim.exists()


def test_another_process_with_the_owner_s_number_is_not_the_owner(left):
    _change_owner(left, 3, os.getpid())
    assert not is_locked(left)


@pytest.mark.parametrize("place", [0, 1, 2], ids=["host", "boot", "container"])
def test_an_owner_elsewhere_lives_as_long_as_it_touches_its_file(left, place):
    _change_owner(left, place, "elsewhere")
    assert is_locked(left)
    an_hour_ago = time.time() - 3600
    os.utime(left.with_name("lock.owner"), (an_hour_ago, an_hour_ago))
    assert not is_locked(left)
    with locked(left):
        assert is_locked(left)


def test_an_owner_s_file_that_was_taken_over_is_left(tmp_path, monkeypatch):
    _refuse_locks(monkeypatch)
    owner = tmp_path / "lock.owner"
    with locked(tmp_path / "lock"):
        owner.write_text("another")
    assert owner.read_text() == "another"


def test_an_owner_touches_its_file(tmp_path, monkeypatch):
    _refuse_locks(monkeypatch)
    monkeypatch.setattr(locking, "_HEARTBEAT_SECONDS", 0.01)
    owner = tmp_path / "lock.owner"
    with locked(tmp_path / "lock"):
        os.utime(owner, (0, 0))
        end = time.monotonic() + 30
        while owner.stat().st_mtime < 1 and time.monotonic() < end:
            time.sleep(0.01)
        assert owner.stat().st_mtime > 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            '["elsewhere", "", "", 7, "1", "2026-01-01"]',
            "process 7 on elsewhere since 2026-01-01",
        ),
        ('["else\\u001b[2Jwhere", "", "", 7, "1", ""]', r"else\?\[2Jwhere"),
        ("[" * 100_000, "an unknown process"),
        ("", "an unknown process"),
    ],
)
def test_another_host_s_owner_is_named_with_the_way_out(
    tmp_path, monkeypatch, content, said
):
    _refuse_locks(monkeypatch)
    (tmp_path / "lock.owner").write_text(content)
    with pytest.raises(InUseError, match=said) as caught, locked(tmp_path / "lock"):
        pass
    assert f"delete {tmp_path / 'lock.owner'}" in str(caught.value)
    assert (tmp_path / "lock.owner").read_text() == content


def test_a_pipe_in_place_of_a_lock_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "lock")
    with pytest.raises(OSError, match="lock"), locked(tmp_path / "lock"):
        pass
