"""Progress names the step, the time that is left, and long steps again."""

import io
import json
import pickle
import time
from contextlib import nullcontext

import pytest

from skinrig import cli
from skinrig.console import Console
from skinrig.progress import BEAT_S, Progress, beat_while_running, watch, watch_start


class Clock:
    """A clock that is set."""

    now = 100.0

    def __call__(self):
        return self.now


def progress(**options):
    clock, stream = Clock(), io.StringIO()
    return Progress(started_s=100.0, clock=clock, stream=stream, **options), clock, stream


def test_counted_parts_estimate_seconds_left():
    """Parts of 3 s each: after 4 of 10 parts 18 s are left."""
    lines, clock, stream = progress(as_json=True)
    for number in range(5):
        lines.begin(f"{number}/10 S{number:03d} subject")
        clock.now += 3.0
    events = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [event["left_s"] for event in events] == [None, 27.0, 24.0, 21.0, 18.0]
    assert [event["seconds"] for event in events] == [0.0, 3.0, 6.0, 9.0, 12.0]


def test_next_round_of_parts_has_its_own_pace():
    """A second round, which begins beyond the first part, is twice as fast: 5 of 10 s are left."""
    lines, clock, stream = progress(as_json=True)
    for number, step_s in ((1, 2.0), (5, 8.0), (10, 10.0), (3, 0.0), (5, 2.0)):
        clock.now += step_s
        lines.begin(f"{number}/10 rows")
    assert json.loads(stream.getvalue().splitlines()[-1])["left_s"] == 5.0


def test_text_skips_parts_that_follow_at_once():
    lines, clock, stream = progress()
    lines.begin("lobes", left_s=30.0)
    for number in range(4):
        lines.begin(f"fit: {number}/4", left_s=20.0 - number)
        clock.now += 1.0
    lines.begin("albedo")
    assert stream.getvalue().splitlines() == [
        "[   0.0 s] lobes (about 30 s left)",
        "[   0.0 s] fit: 0/4 (about 20 s left)",
        "[   4.0 s] albedo",
    ]


def test_long_step_is_reported_again_with_less_left():
    lines, clock, stream = progress()
    lines.begin("chromophores", left_s=60.0)
    for _ in range(2):
        clock.now += BEAT_S
        lines.beat()
    lines.beat()  # at once: nothing
    assert stream.getvalue().splitlines()[1:] == [
        "[   4.0 s] still at chromophores (about 56 s left)",
        "[   8.0 s] still at chromophores (about 52 s left)",
    ]


def test_thread_beats_only_while_command_runs():
    clock, stream = Clock(), io.StringIO()
    lines = Progress(started_s=100.0, clock=clock, stream=stream)
    with beat_while_running():
        watch(lines)
        lines.begin("integrate")
        clock.now += BEAT_S
        deadline = time.monotonic() + 20.0
        while "still" not in stream.getvalue() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert stream.getvalue().count("still at integrate") == 1
        watch(None)  # a result was printed
        clock.now += BEAT_S
        time.sleep(1.5)
    assert stream.getvalue().count("still at integrate") == 1


def test_late_first_step_reports_loading(capsys, monkeypatch):
    monkeypatch.setattr("skinrig.progress.BEAT_S", 0.0)
    watch_start(True)
    console = Console(True)
    time.sleep(0.05)
    err = ""
    with beat_while_running():
        deadline = time.monotonic() + 20.0
        while not err and time.monotonic() < deadline:
            time.sleep(0.01)
            err = capsys.readouterr().err
        assert Console(True).started_s == console.started_s  # seconds never run backward
        console.print_line("done")
    assert json.loads(err.splitlines()[0])["text"] == "load the libraries"
    assert capsys.readouterr().err.splitlines()[-1] == "done"


@pytest.mark.parametrize(
    ("argv", "beats"),
    [
        (["report", "capture", "--out", "r"], True),
        (["--verbose", "report", "serve"], True),
        (["capture", "no_rig"], False),
        (["--verbose", "serve", "no_rig"], False),
    ],
)
def test_commands_that_wait_report_no_beats(argv, beats, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    begun = []
    monkeypatch.setattr(cli, "beat_while_running", lambda: nullcontext(begun.append(1)))
    assert cli.main(argv) != 0
    assert bool(begun) == beats


def test_console_json_progress_is_one_event_per_line(capsys):
    console = pickle.loads(pickle.dumps(Console(True)))  # as for a rig of the demo
    console.progress("strain")
    console.progress("kernels: 1/4", 12.34)
    out, err = capsys.readouterr()
    assert out == ""
    events = [json.loads(line) for line in err.splitlines()]
    assert [(event["event"], event["text"], event["left_s"]) for event in events] == [
        ("progress", "strain", None),
        ("progress", "kernels: 1/4", 12.3),
    ]
