"""The progress line, in terminals and log files."""

import io

import pytest

from jaxil.machine.progress import ProgressLine, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def make_line(stream, total_frames=10_000, **options):
    clock = Clock()
    return ProgressLine(total_frames, stream=stream, clock=clock, **options), clock


def test_the_line_by_hand():
    stream = io.StringIO()
    line, clock = make_line(stream)
    clock.seconds = 10.0
    line.update(1000, {"environment": 2.0, "update": 7.5}, {"task": 12.34})

    # 1000 frames in 10 s; 2, 7.5 and 0.5 s of the 10; 9000 frames left at 100 a second.
    assert stream.getvalue() == (
        "1000/10000 frames (10.0 %) | 100 frames/s"
        " | environment 20% update 75% rest 5% | return task 12.3 ▁ | 2 min left\n"
    )


def test_returns_are_a_curve_from_the_first_episode_on():
    stream = io.StringIO()
    line, clock = make_line(stream)
    for episode in range(32):  # all but the last between two lines
        returns = {"task": 10.0 * episode, "imitation": -1.0}
        clock.seconds = episode / 16 + (episode == 31)
        line.update(100 * episode, {}, returns)
        line.update(100 * episode + 50, {}, returns)  # the same episode still
    clock.seconds = 40.0
    line.update(3200, {}, returns)
    # Sixteen letters, each of two episodes; eight heights.
    assert "return task 310.0 imitation -1.0 ▁▁▂▂▃▃▄▄▅▅▆▆▇▇██ |" in stream.getvalue()


def test_a_return_that_is_not_a_number_is_shown_and_no_point_of_the_curve():
    stream = io.StringIO()
    line, clock = make_line(stream)
    for value in (float("nan"), 1.0, 2.0):
        clock.seconds += 60.0
        line.update(1000, {}, {"task": value})
    shown = [text.split(" | ")[2] for text in stream.getvalue().splitlines()]
    assert shown == ["return task nan", "return task 1.0 ▁", "return task 2.0 ▁█"]


def test_a_terminal_has_one_live_line_and_messages_above(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    line, clock = make_line(stream, label="[run]")
    for frame in (0, 5, 30):  # the second one comes too soon
        clock.seconds = frame / 100
        line.update(frame, {})
    line.message("[saved]" + "x" * 200)
    line.close()

    shown = stream.getvalue()
    assert shown.count("[run]: 30/10000 frames") >= 1
    assert "[run]: 5/" not in shown
    assert shown.count("[saved]" + "x" * 200) == 1
    assert "\n" in shown[-8:]  # what follows is only the cursor's return


def test_a_dumb_terminal_gets_plain_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    stream = Terminal()
    line, clock = make_line(stream)
    clock.seconds = 4.0
    line.update(8, {})
    line.close()
    assert stream.getvalue().startswith("8/10000")
    assert "\x1b" not in stream.getvalue()


def test_a_log_file_gets_a_line_every_30_seconds():
    stream = io.StringIO()
    line, clock = make_line(stream)
    for frame in range(200):
        clock.seconds = frame
        line.update(frame, {})

    assert len(stream.getvalue().splitlines()) == 7  # after 3, 33, ... 183 seconds


def test_frames_before_anything_is_learned_tell_nothing_of_the_time_left():
    stream = io.StringIO()
    line, clock = make_line(stream, total_frames=10_000, steady_from=4_000)
    frame = 0
    for second in range(130):
        clock.seconds = second
        if second < 40 or second >= 60:  # compiled in between
            frame += 100 if second < 40 else 10
        line.update(frame, {})
    shown = stream.getvalue().splitlines()  # after 3, 33, 63, 93 and 123 seconds
    assert ["left" in text for text in shown] == [False, False, False, True, True]
    assert "| 10 frames/s |" in shown[3]  # since it is compiled, not of a minute


def test_speed_follows_a_change():
    stream = io.StringIO()
    line, clock = make_line(stream, total_frames=10**6)
    frame = 0
    for second in range(600):
        clock.seconds = second
        frame += 10 if second < 300 else 50
        line.update(frame, {})

    assert "| 50 frames/s |" in stream.getvalue().splitlines()[-1]


def test_speed_after_a_resume_counts_this_process_only():
    stream = io.StringIO()
    line, clock = make_line(stream, first_frame=5000)
    clock.seconds = 10.0
    line.update(5100, {})

    assert "| 10 frames/s | 8 min left" in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min"),
        (3569, "59 min"),
        (3590, "1 h 00 min"),
        (11_100, "3 h 05 min"),
        (187_200, "2 d 04 h"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text
