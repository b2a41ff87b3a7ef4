"""A run outlives its terminal and the pipe that it writes to."""

import os
import signal
import subprocess
import sys

import pytest

from jaxil.errors import Fault, UsageError
from jaxil.machine import screen
from jaxil.machine.progress import ProgressLine
from jaxil.machine.signals import StopOnSignals
from tests.processes import ROOT


def test_a_closed_stream_is_given_up(tmp_path, monkeypatch):
    closed = (tmp_path / "out").open("w")
    closed.close()
    for stream in (closed, None):
        monkeypatch.setattr(sys, "stderr", stream)
        screen.say("nobody hears this")
    line = ProgressLine(10, stream=closed)
    line.message("nor this")
    line.close()
    assert (tmp_path / "out").read_text() == ""


def test_what_a_terminal_cannot_show_is_replaced(tmp_path):
    with (tmp_path / "log").open("w", encoding="latin-1") as stream:
        lasting = screen.LastingStream(stream)
        lasting.write("return 1.0 ± 0.5 \u2581\u2588\n")
        lasting.write("saved\n")
    text = (tmp_path / "log").read_text(encoding="latin-1")
    assert text == "return 1.0 ± 0.5 ??\nsaved\n"


def test_text_from_files_cannot_command_the_terminal(capsys):
    hostile = "name\x1b[2J\r\x9b31m" + 10_000 * "x"
    screen.say(f"first {hostile}\nsecond")
    fault = Fault("method", "is unknown", value=hostile)
    for error in (UsageError(fault), UsageError([fault, hostile])):
        print(error, file=sys.stderr)
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "second"
    assert len(lines) == 6
    assert all(line.isprintable() and len(line) < 5000 for line in lines)


@pytest.mark.parametrize("ending", ["closed pipe", "full disk"])
def test_a_process_trains_on_when_nobody_reads(ending):
    # Also what others print to the same stream then, and the flush at the exit.
    program = """
import sys
from jaxil.errors import Fault, UsageError
from jaxil.machine import screen
from jaxil.machine.progress import ProgressLine
screen.say("begins")
sys.stdin.readline()
for number in range(3):
    screen.say("x" * 100)
print("y" * 100, file=sys.stderr)
line = ProgressLine(10)
line.message("z")
line.close()
sys.exit(7)
"""
    read, write = os.pipe()
    if ending == "full disk":
        os.close(write)
        write = os.open("/dev/full", os.O_WRONLY)
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stderr=write, cwd=ROOT
    )
    os.close(write)
    if ending == "closed pipe":
        assert os.read(read, 6) == b"begins"
    os.close(read)
    process.communicate(b"\n", timeout=60)
    assert process.returncode == 7


def send_and_collect(*numbers):
    asked = []

    def ask(who):
        asked.append(who)
        return len(asked) == 1

    with StopOnSignals(ask):
        for number in numbers:
            signal.raise_signal(number)
    return asked


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (signal.SIGINT, "Ctrl-C"),
        (signal.SIGTERM, "SIGTERM"),
        (signal.SIGHUP, "SIGHUP"),
    ],
)
def test_the_first_signal_asks_and_a_second_ends(number, name):
    before = signal.getsignal(number)
    assert send_and_collect(number) == [name]
    with pytest.raises(KeyboardInterrupt):
        send_and_collect(number, signal.SIGINT)
    assert signal.getsignal(number) == before


def test_a_terminal_that_is_closed_twice_does_not_end_the_saving():
    assert send_and_collect(signal.SIGHUP, signal.SIGHUP) == ["SIGHUP", "SIGHUP"]


def test_nohup_is_respected():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert send_and_collect(signal.SIGHUP) == []
    finally:
        signal.signal(signal.SIGHUP, before)
