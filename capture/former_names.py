"""Names of version 1 of the file formats, translated when a file is read.

Version 2 of SESSION/ and CALIBRATION/ writes ``fiber``, ``analyzer`` and ``omission`` where
version 1 wrote ``fibre``, ``analyser`` and ``left_out``. Files of version 1 are read, never
rewritten: hashes and seals are checked on the bytes as written, before the translation.
"""

from collections.abc import Mapping
from typing import Any, Final

FORMER_NAMES: Final[Mapping[str, str]] = {
    "fibre": "fiber",
    "fibres": "fibers",
    "analyser_deg": "analyzer_deg",
    "analyser_axis_deg": "analyzer_axis_deg",
    "analyser_zero": "analyzer_zero",
    "analyser_zero_rad": "analyzer_zero_rad",
    "analyser_leak": "analyzer_leak",
}
"""Present name of a key, a kind of steps or a kind of calibrations, by its name in version 1."""
FORMER_KINDS: Final = {present: former for former, present in FORMER_NAMES.items()}
"""Kind of calibrations in version 1, which names the file, by its present name."""


def translate_names(data: Any) -> Any:
    """Return decoded JSON or TOML with present names for keys and for values of ``kind``.

    A table that has a name in both spellings keeps both, and data nested too deeply stay as they
    are: the strict parser, which reads the result, refuses either with its place.

    Examples
    --------
    >>> translate_names({"kind": "fibres", "settings": {"fibre": 3}, "id": "fibre"})
    {'kind': 'fibers', 'settings': {'fiber': 3}, 'id': 'fibre'}
    >>> translate_names({"fibre": 3, "fiber": 4})
    {'fibre': 3, 'fiber': 4}
    """
    try:
        return _translate(data)
    except RecursionError:
        return data


def _translate(data: Any) -> Any:
    if isinstance(data, list | tuple):
        return [_translate(item) for item in data]
    if not isinstance(data, Mapping):
        return data
    table = {}
    for key, value in data.items():
        present = FORMER_NAMES.get(key, key)
        table[key if present in data else present] = _translate(value)
    kind = table.get("kind")
    return table | {"kind": FORMER_NAMES.get(kind, kind)} if isinstance(kind, str) else table
