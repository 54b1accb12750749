"""Progress of a command on stderr: steps, the time that is left, and a sign of life in long steps.

The line after a step comes when the next step begins, or after `BEAT_S` from a thread. With
``--json`` each line is an event, one JSON object.
"""

import json
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, TextIO

BEAT_S: Final = 4.0
"""Seconds after which a step that still runs is reported again."""
PART_INTERVAL_S: Final = 4.0
"""Seconds between two lines about parts of the same step."""
_COUNTED = re.compile(r"(\d+)/(\d+)")


def format_seconds(seconds: float) -> str:
    """Format a duration for a message, in s below two minutes, else in min.

    Examples
    --------
    >>> format_seconds(42.4), format_seconds(150.0)
    ('42 s', '2.5 min')
    """
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


@dataclass(slots=True)
class Progress:
    """Progress of one command.

    Attributes
    ----------
    as_json
        Whether lines are events.
    started_s
        Clock at the command's start.
    clock
        Seconds.
    stream
        None: the standard error at the time of printing.
    """

    as_json: bool = False
    started_s: float = 0.0
    clock: Callable[[], float] = time.perf_counter
    stream: TextIO | None = None
    _text: str = ""
    _printed_s: float = float("-inf")
    _left: tuple[float, float] | None = None
    """Seconds that were left, and the clock then."""
    _counted: tuple[str, int, float] | None = None
    """First part of a counted step: name of the step, number and clock."""
    _last_number: int = 0
    """Number of the latest part; a smaller one begins another round."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, text: str, left_s: float | None = None) -> None:
        """Report the beginning of a step or part; see `skinrig.console.Console.progress`."""
        with self._lock:
            now = self.clock()
            part = _COUNTED.search(text)
            same = bool(part) and self._step(text) == self._step(self._text)
            if left_s is None and part is not None:
                left_s = self._left_by_count(text, int(part[1]), int(part[2]), now)
            if left_s is not None:
                self._left = left_s, now
            elif not same:
                self._left = None
            self._text = text
            if self.as_json or not same or now - self._printed_s >= PART_INTERVAL_S:
                self._print("progress", now)

    def beat(self) -> None:
        """Report the step again if nothing was printed for `BEAT_S`."""
        with self._lock:
            now = self.clock()
            if self._text and now - self._printed_s >= BEAT_S:
                self._print("running", now)

    @staticmethod
    def _step(text: str) -> str:
        return _COUNTED.split(text)[0]

    def _left_by_count(self, text: str, number: int, total: int, now: float) -> float | None:
        """Estimate the seconds that are left by the pace of the parts so far."""
        step = self._step(text)
        if self._counted is None or self._counted[0] != step or number < self._last_number:
            self._counted = step, number, now
        self._last_number = number
        _, first, began_s = self._counted
        if number <= first or total < number:
            return None
        return (now - began_s) / (number - first) * (total - number)

    def _print(self, event: str, now: float) -> None:
        left_s = None
        if self._left is not None:
            left_s = max(self._left[0] - (now - self._left[1]), 0.0)
        seconds = now - self.started_s
        self._printed_s = now
        stream = self.stream or sys.stderr
        if self.as_json:
            rest = None if left_s is None else round(left_s, 1)
            line = json.dumps(
                {"event": event, "seconds": round(seconds, 3), "text": self._text, "left_s": rest}
            )
        else:
            still = "still at " if event == "running" else ""
            left = f" (about {format_seconds(left_s)} left)" if left_s else ""
            line = f"[{seconds:6.1f} s] {still}{self._text}{left}"
        print(line, file=stream, flush=True)


_watched: list[Progress] = []
"""Progress of the command that runs in this process; empty before its first step."""


def watch(progress: Progress | None) -> None:
    """Let `beat_while_running` report the steps of this progress, and of no other."""
    _watched[:] = [] if progress is None else [progress]


def command_start_s() -> float:
    """Return the clock at the command's start, or now where no step is watched."""
    return _watched[0].started_s if _watched else time.perf_counter()


def watch_start(as_json: bool) -> None:
    """Report the loading of libraries, if the first step comes late."""
    now = time.perf_counter()
    watch(Progress(as_json, now, _text="load the libraries", _printed_s=now))


@contextmanager
def beat_while_running() -> Iterator[None]:
    """Report long steps of the block from a thread."""
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(1.0):
            for progress in tuple(_watched):
                progress.beat()

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        watch(None)
