"""A generator function in a child process: its results, and how it fails."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxil.machine.child import ChildError, results
from tests.processes import ROOT

LIMITS: dict = {
    "seconds": 60.0,
    "cpu_seconds": 20,
    "memory_bytes": 2**29,
    "result_bytes": 10**8,
}


def echo(prefix, items):
    yield "ready"
    for item in items:
        yield [prefix, item]


def misbehave(how):
    yield os.getpid()
    if how == "raises":
        raise KeyError("x")
    if how == "crashes":
        os.abort()
    if how == "exits":
        os._exit(3)
    if how == "computes for ever":
        while True:
            pass
    if how == "waits for ever":
        time.sleep(100)
    if how == "sends byte by byte":
        code = " ".join(sys.orig_argv)
        handle = int(code.partition("child.serve(")[2].partition(")")[0])
        while True:
            os.write(handle, b"1")
            time.sleep(0.2)
    if how == "fills the memory":
        yield len(bytearray(2**30))
    if how == "sends too much":
        yield np.zeros(10**6)
    if how == "sends objects":
        yield np.array([{}])


def test_requests_and_answers_of_all_kinds():
    sent = {
        "numbers": [1, 2.5, -(10**30), float("inf"), True, None],
        "text": "ü\0\n\ud800",
        "scalar": np.array(3, np.int16),
        "empty": np.zeros((0, 3), np.float32),
        "large": np.arange(3 * 10**6, dtype=np.int32).reshape(3, -1).T,
    }
    scalar = np.float32(0.5)
    ready, *answers, last = results(echo, ">", [sent, sent, scalar], **LIMITS)
    assert ready == "ready"
    assert last == [">", 0.5]
    for prefix, answer in answers:
        assert prefix == ">"
        assert answer.keys() == sent.keys()
        for name, value in sent.items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(answer[name], value, strict=True)
            else:
                assert answer[name] == value


def test_a_child_ends_with_its_last_reader():
    child = results(misbehave, "waits for ever", **LIMITS)
    pid = next(child)
    child.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize(
    ("how", "kind", "text"),
    [
        ("raises", "KeyError", "'x'"),
        ("crashes", "death", "SIGABRT"),
        ("exits", "death", "exit status 3"),
        ("computes for ever", "timeout", "computed for 1 s"),
        ("waits for ever", "timeout", "within 5.0 s"),
        ("sends byte by byte", "timeout", "within 5.0 s"),
        ("fills the memory", "MemoryError", "MemoryError"),
        ("sends too much", "death", "invalid result"),
        ("sends objects", "death", "invalid result|exit status 1"),
    ],
)
def test_faults_of_the_child_are_named(how, kind, text, monkeypatch):
    monkeypatch.setattr("jaxil.machine.child._EXIT_SECONDS", 0.1)
    limits = LIMITS | {"cpu_seconds": 1, "result_bytes": 10**6}
    if kind == "timeout" and how != "computes for ever":
        limits["seconds"] = 5.0
    child = results(misbehave, how, **limits)
    next(child)
    with pytest.raises(ChildError, match=text) as caught:
        next(child)
    assert caught.value.kind == kind


def test_a_script_without_main_guard_is_not_run_again(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from jaxil.machine.child import results\n"
        "from tests.machine.test_child import LIMITS, echo\n"
        "print('once')\n"
        "print(*results(echo, '', [], **LIMITS))\n"
    )
    done = subprocess.run(
        [sys.executable, script],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "once\nready\n", done.stderr
