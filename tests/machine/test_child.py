"""A function in a process of its own: what comes back, and how it ends."""

import os
import pathlib
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxil.machine.child import Child, ChildError


def echo(prefix):
    request = yield "ready"
    while request is not None:
        request = yield [prefix, request]


def misbehave(how):
    yield "ready"
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
    with Child(echo, ">") as child:
        assert next(child) == "ready"
        for _ in range(2):
            child.ask(sent)
            prefix, answer = child.answer()
            assert prefix == ">"
            assert answer.keys() == sent.keys()
            for name, value in sent.items():
                if isinstance(value, np.ndarray):
                    np.testing.assert_array_equal(answer[name], value, strict=True)
                else:
                    assert answer[name] == value
        child.ask(np.float32(0.5))
        assert child.answer() == [">", 0.5]
        with pytest.raises(StopIteration):
            next(child)


@pytest.mark.parametrize(
    ("how", "kind", "text"),
    [
        ("raises", "KeyError", "'x'"),
        ("crashes", "death", "SIGABRT"),
        ("exits", "death", "exit status 3"),
        ("computes for ever", "timeout", "computed for 1 s"),
        ("waits for ever", "timeout", "within 3.0 s"),
        ("fills the memory", "MemoryError", "MemoryError"),
        ("sends too much", "death", "understood"),
        ("sends objects", "death", "understood"),
    ],
)
def test_faults_of_the_child_are_named(how, kind, text, monkeypatch):
    monkeypatch.setattr("jaxil.machine.child._EXIT_SECONDS", 0.1)
    limits = {"cpu_seconds": 1, "memory_bytes": 2**29, "answer_bytes": 10**6}
    with Child(misbehave, how, seconds=60.0, **limits) as child:
        assert next(child) == "ready"
        if how == "waits for ever":
            child._seconds = 3.0
        with pytest.raises(ChildError, match=text) as caught:
            next(child)
    assert caught.value.kind == kind
    assert child._process.returncode is not None


def test_a_script_without_main_guard_is_not_run_again(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from jaxil.machine.child import Child\n"
        "from tests.machine.test_child import echo\n"
        "print('once')\n"
        "with Child(echo, '') as child:\n"
        "    print(next(child))\n"
    )
    root = pathlib.Path(__file__).parent.parent.parent
    done = subprocess.run(
        [sys.executable, script],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "once\nready\n", done.stderr
