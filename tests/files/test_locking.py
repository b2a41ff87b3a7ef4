"""Locks, also on file systems that have none."""

import errno
import fcntl
import json
import os
import platform
import subprocess
import sys

import pytest

from jaxil.files.locking import InUseError, is_locked, locked


@pytest.fixture(params=[None, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def lock(request, tmp_path, monkeypatch):
    """A path, where flock works or says that it cannot."""
    if request.param is not None:

        def refuse(*_):
            raise OSError(request.param, os.strerror(request.param))

        monkeypatch.setattr(fcntl, "flock", refuse)
    return tmp_path / "lock"


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
    def fail(*_):
        raise OSError(errno.EIO, "input/output error")

    monkeypatch.setattr(fcntl, "flock", fail)
    with pytest.raises(OSError, match="input/output"), locked(tmp_path / "lock"):
        pass


def _without_locks(monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_a_dead_owner_is_replaced(tmp_path, monkeypatch):
    _without_locks(monkeypatch)
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    content = [platform.node(), process.pid, "2026-01-01 00:00:00"]
    (tmp_path / "lock.owner").write_text(json.dumps(content))
    with locked(tmp_path / "lock"):
        owner = json.loads((tmp_path / "lock.owner").read_text())
        assert owner[:2] == [platform.node(), os.getpid()]
    assert not (tmp_path / "lock.owner").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('["elsewhere", 7, "2026-01-01"]', "process 7 on elsewhere since 2026-01-01"),
        ("[" * 100_000, "an unknown process"),
        ("", "an unknown process"),
    ],
)
def test_another_host_s_owner_is_named_with_the_way_out(
    tmp_path, monkeypatch, content, said
):
    _without_locks(monkeypatch)
    (tmp_path / "lock.owner").write_text(content)
    with pytest.raises(InUseError, match=said) as caught, locked(tmp_path / "lock"):
        pass
    assert f"delete {tmp_path / 'lock.owner'}" in str(caught.value)
    assert (tmp_path / "lock.owner").read_text() == content
