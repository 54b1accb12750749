"""Print results of commands on stdout, progress on stderr, and one document with --json."""

import json
import logging
import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from skinrig.progress import Progress, command_start_s, watch


def to_json_value(value: Any) -> Any:
    """Convert a value to JSON types; NaN and infinities become None.

    Examples
    --------
    >>> from pathlib import Path
    >>> to_json_value({"error": float("nan"), "sizes": (1, 2), "folder": Path("out")})
    {'error': None, 'sizes': [1, 2], 'folder': 'out'}
    """
    if value is None or isinstance(value, (str, int)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_json_value(item) for item in value]
    # duck-typed: importing NumPy here would add 0.1 s to the start of every command
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    return str(value)


_CONTROL_CHARACTERS = re.compile(
    "[\x00-\x06\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def escape_controls(text: str) -> str:
    r"""Replace characters that command a terminal by their escapes; bell, tab and newline are kept.

    Names and notes of other people's sessions may contain them.

    Examples
    --------
    >>> escape_controls("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    return _CONTROL_CHARACTERS.sub(
        lambda found: found[0].encode("unicode_escape").decode("ascii"), text
    )


def select_attributes(source: object, *names: str) -> dict[str, Any]:
    """Return attributes of an object, keyed by name.

    Examples
    --------
    >>> select_attributes(3 + 4j, "real", "imag")
    {'real': 3.0, 'imag': 4.0}
    """
    return {name: getattr(source, name) for name in names}


def format_count(number: int, noun: str) -> str:
    """Format a number with a noun whose plural ends in s.

    Examples
    --------
    >>> format_count(1, "photograph"), format_count(0, "frame")
    ('1 photograph', '0 frames')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return "–" if math.isnan(value) else f"{value:.4g}"


class EscapingFormatter(logging.Formatter):
    """Formatter of log records whose control characters are escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as text for a terminal."""
        return escape_controls(super().format(record))


@dataclass(slots=True)
class Console:
    """Output streams of a command.

    With ``as_json``, stdout gets only the document of :meth:`print_document`; text goes to stderr.
    """

    as_json: bool = False
    quiet: bool = False
    """Whether only progress is printed: the caller prints its own summary."""
    started_s: float = field(default_factory=command_start_s)
    _progress: Progress = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Begin the progress of the command."""
        self._progress = Progress(self.as_json, self.started_s)

    def __reduce__(self) -> tuple[type, tuple[bool, bool, float]]:
        """Let another process continue with its own progress."""
        return type(self), (self.as_json, self.quiet, self.started_s)

    def print_line(self, text: str = "") -> None:
        """Print a line of text; the step of the progress ends."""
        watch(None)
        if not self.quiet:
            stream = sys.stderr if self.as_json else sys.stdout
            print(escape_controls(text), file=stream, flush=True)

    def progress(self, text: str, left_s: float | None = None) -> None:
        """Print progress on stderr: a line of text, or with --json an event.

        Parameters
        ----------
        text
            Step that begins; for one part of several with "number/count". Lines about parts of
            the same step are not printed more often than every few seconds; events always are.
        left_s
            Estimated seconds that are left; None: by the pace of counted parts, or unknown.
        """
        watch(self._progress)
        self._progress.begin(escape_controls(text), left_s)

    def print_table(self, head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
        """Print a table with aligned columns; NaN is printed as a dash."""
        cells = [[str(h) for h in head]] + [[_cell(value) for value in row] for row in rows]
        widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
        for row in cells:
            line = "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True))
            self.print_line(line.rstrip())

    def print_figures(
        self, parts: Mapping[str, Mapping[str, object]], *kinds: type[int | float | str]
    ) -> None:
        """Print the figures of each part whose values have one of the given types."""
        rows = [
            (part, name, value)
            for part, figures in parts.items()
            for name, value in figures.items()
            if isinstance(value, kinds)
        ]
        if rows:
            self.print_table(("part", "figure", "value"), rows)

    def print_each(self, label: str, texts: Iterable[object]) -> None:
        """Print each text on its own line, after a label."""
        for text in texts:
            self.print_line(f"{label}: {text}")

    def print_omissions(self, rows: Iterable[tuple[object, object]]) -> None:
        """Print what was omitted, with reasons."""
        self.print_each("omitted", (f"{what}: {why}" for what, why in rows))

    def print_document(self, schema: str, content: Mapping[str, Any]) -> None:
        """Print the command's JSON document if --json was given."""
        if self.as_json:
            print(
                json.dumps({"schema": schema, **to_json_value(content)}, allow_nan=False),
                flush=True,
            )
