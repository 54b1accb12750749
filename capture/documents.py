"""Parse small TOML and JSON documents strictly: list every fault, with path and near miss.

A document is a frozen dataclass. Types, unknown keys and non-finite numbers are checked by
pydantic, ranges by the dataclass's own ``__post_init__``, so that a file and a constructor obey
the same rules.
"""

import difflib
import json
import math
import tomllib
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from dataclasses import fields as dataclass_fields
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

STRICT_CONFIG = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

_T = TypeVar("_T")

# SI value of one unit, per quantity; two suffixes of one row can be converted into each other
_SI_UNITS: tuple[dict[str, float], ...] = (
    {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0},
    {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0},
    {"deg": math.pi / 180.0, "rad": 1.0},
    {"mws": 1e-3, "ws": 1.0, "j": 1.0, "kj": 1e3},
)


class Document:
    """Base of dataclasses in files: no unknown keys, no conversions, finite numbers."""

    __slots__ = ()
    __pydantic_config__: ClassVar[ConfigDict] = STRICT_CONFIG

    def to_json(self) -> dict[str, Any]:
        """Return the fields as `json` writes them; see `to_json_table`."""
        return to_json_table(self)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a document: its path, the value found, the value expected."""

    path: str
    got: str
    expected: str
    hint: str = ""
    """A near miss, empty without one."""

    def __str__(self) -> str:
        """Return ``path: got X, expected Y; hint``."""
        text = f"{self.path or 'document'}: got {self.got}, expected {self.expected}"
        return f"{text}; {self.hint}" if self.hint else text


class InputError(ValueError):
    """Raised for an input that cannot be used: what, where, got, expected, what to do.

    Parameters
    ----------
    what : str
        Fault, in a few words.
    where : str
        File (and byte, when known), empty for values built in memory.
    faults : sequence of Fault
        All faults, in document order.
    advice : str
        Advice to the user.
    code : str
        Stable code such as ``SR-SES-000``, which ends the message; empty for rare errors.

    Examples
    --------
    >>> print(InputError("is closed", where="s1", advice="Start a new one.", code="SR-SES-000"))
    s1: is closed
      Start a new one. [SR-SES-000]
    """

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        faults: Sequence[Fault] = (),
        advice: str = "",
        code: str = "",
    ) -> None:
        self.what = what
        self.where = where
        self.faults = tuple(faults)
        self.advice = advice
        self.code = code
        head = f"{where}: {what}" if where else what
        listed = "".join(f"\n  {fault}" for fault in self.faults)
        text = head + listed + (f"\n  {advice}" if advice else "")
        super().__init__(f"{text} [{code}]" if code else text)

    @classmethod
    def at(
        cls,
        problem: str,
        path: str,
        got: str,
        expected: str,
        *,
        where: object = "",
        advice: str = "",
        code: str = "",
    ) -> Self:
        """Return the error of one fault, at a path in a document or file."""
        faults = [Fault(path, got, expected)]
        return cls(problem, where=str(where), faults=faults, advice=advice, code=code)

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the parts when the error is passed between processes."""
        parts = (self.what, self.where, self.faults, self.advice, self.code)
        return (_rebuild, (type(self), *parts))


def _rebuild(
    kind: type[InputError], what: str, where: str, faults: tuple[Fault, ...], advice: str, code: str
) -> InputError:
    return kind(what, where=where, faults=faults, advice=advice, code=code)


class FaultCollector:
    """Collect the faults of one value and raise them together.

    Examples
    --------
    >>> checks = FaultCollector("Light 'left'", InputError)
    >>> checks.check("radius_mm", -3.0, False, "> 0")
    >>> checks.close()
    Traceback (most recent call last):
        ...
    capture.documents.InputError: Light 'left' is not valid
      radius_mm: got -3.0, expected > 0
    """

    def __init__(self, what: str, error: type[InputError]) -> None:
        self._what = what
        self._error = error
        self._faults: list[Fault] = []

    def check(self, field: str, got: object, good: bool, expected: str) -> None:
        """Add a fault of ``field`` unless ``good``."""
        if not good:
            self._faults.append(Fault(field, short_repr(got), expected))

    def note(self, fault: Fault) -> None:
        """Add a fault found elsewhere."""
        self._faults.append(fault)

    def check_finite(self, **values: float | Iterable[float]) -> None:
        """Add a fault for each value (or row of values) that is not finite."""
        for field, value in values.items():
            row = (value,) if isinstance(value, int | float) else tuple(value)
            self.check(field, value, all(math.isfinite(x) for x in row), "finite numbers")

    def check_positive(self, **values: float) -> None:
        """Add a fault for each value that is not a finite number above zero."""
        for field, value in values.items():
            self.check(field, value, math.isfinite(value) and value > 0, "a finite number > 0")

    def close(self, *, advice: str = "", code: str = "") -> None:
        """Raise an error with all faults, ``advice`` and ``code``, or return."""
        if self._faults:
            what = f"{self._what} is not valid"
            raise self._error(what, faults=self._faults, advice=advice, code=code)


def short_repr(value: object) -> str:
    """Return a short ``repr`` of ``value`` for a message."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def parse_document(
    kind: type[_T],
    data: object,
    *,
    where: str,
    error: type[InputError],
    advice: str = "",
    code: str = "",
) -> _T:
    """Build the frozen dataclass ``kind`` from decoded TOML or JSON, strictly.

    Parameters
    ----------
    kind : type
        Dataclass, its nested dataclasses carrying ``__pydantic_config__ = STRICT``.
    data : object
        Result of ``tomllib`` or ``json``.
    where : str
        Name of the file for the message.
    error : type of InputError
        Class of the error, raised once, with all faults.
    advice, code : str
        Advice and code of that error.
    """
    bad: list[Fault] = []
    try:
        text = json.dumps(_replace_non_json(data, "", bad), allow_nan=False)
        value: _T = _adapter(typing.cast(typing.Any, kind)).validate_json(text)
    except RecursionError as exc:
        raise error("is nested too deeply", where=where) from exc
    except ValidationError as exc:
        lines = exc.errors(include_url=False)
        known = {fault.path for fault in bad}
        bad += [f for line in lines for f in _faults(line, kind) if f.path not in known]
        raise error(_count(bad), where=where, faults=bad, advice=advice, code=code) from exc
    if bad:
        raise error(_count(bad), where=where, faults=bad, advice=advice, code=code)
    return value


def read_toml(path: Path, *, error: type[InputError]) -> dict[str, Any]:
    """Return the tables of a TOML file, or raise ``error`` naming file, line and column."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as exc:
        advice = "Check the name, and the folder that the command runs in."
        raise error("file not found", where=str(path), advice=advice, code="SR-CLI-012") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as exc:
        advice = "Correct the file at that place."
        what = f"is not TOML: {exc}"
        raise error(what, where=str(path), advice=advice, code="SR-CLI-013") from exc
    except OSError as exc:
        raise error(f"cannot be read: {exc.strerror}", where=str(path)) from exc


def read_json(text: str | bytes, *, where: str, error: type[InputError]) -> Any:
    """Decode JSON without NaN, infinities and doubled keys."""

    def no_constant(name: str) -> NoReturn:
        raise ValueError(f"got {name}, expected a finite number")

    def no_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) != len(pairs):
            seen: set[str] = set()
            twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
            raise ValueError(f"key {twice!r} is twice in one table")
        return table

    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
        return json.loads(decoded, parse_constant=no_constant, object_pairs_hook=no_doubles)
    except (ValueError, RecursionError) as exc:
        advice = "Correct the file, or restore it from a copy."
        raise error(f"is not JSON: {exc}", where=where, advice=advice, code="SR-CLI-014") from exc


def canonical_json(data: object) -> bytes:
    r"""Return the canonical bytes of ``data``: sorted keys, no spaces, ASCII.

    Examples
    --------
    >>> canonical_json({"b": 1, "a": [0.5, "é"]})
    b'{"a":[0.5,"\\u00e9"],"b":1}'
    """
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def to_json_table(row: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values, including those of nested dataclasses.

    Parameters
    ----------
    row : dataclass
        Tuples become lists, and dates ISO 8601; values in mappings are unchanged.

    Examples
    --------
    >>> to_json_table(Fault("a", "1", "2"))
    {'path': 'a', 'got': '1', 'expected': '2', 'hint': ''}
    """
    return {field.name: _plain(getattr(row, field.name)) for field in dataclass_fields(row)}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_json_table(value)
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, date):
        return value.isoformat()
    return dict(value) if isinstance(value, Mapping) else value


def suggest_key(key: str, known: Iterable[str]) -> str:
    """Return a suggestion for an unknown key, empty when nothing is near.

    Examples
    --------
    >>> suggest_key("wavelength_um", ["wavelength_nm", "width_px"])
    'did you mean wavelength_nm? (x1000)'
    >>> suggest_key("focal", ["focal_mm"])
    'did you mean focal_mm? (in mm)'
    """
    names = list(known)
    stem, _, unit = key.rpartition("_")
    for name in names:
        name_stem, _, name_unit = name.rpartition("_")
        if name_stem == key:
            return f"did you mean {name}? (in {name_unit})"
        factor = _unit_factor(unit, name_unit)
        if stem == name_stem and stem and factor is not None:
            return f"did you mean {name}?" + ("" if factor == 1 else f" (x{factor:.6g})")
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.7)
    return f"did you mean {close[0]}?" if close else ""


def _unit_factor(unit: str, target: str) -> float | None:
    for row in _SI_UNITS:
        if unit in row and target in row:
            return row[unit] / row[target]
    return None


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _path(location: Iterable[object]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _faults(line: Any, kind: type) -> Iterable[Fault]:
    """Translate one pydantic error into our faults."""
    location = tuple(line["loc"])
    cause = line.get("ctx", {}).get("error")
    if isinstance(cause, InputError) and cause.faults:
        for fault in cause.faults:
            yield Fault(_path((*location, fault.path)), fault.got, fault.expected, fault.hint)
        return
    if line["type"] == "unexpected_keyword_argument":
        known = sorted(_known_keys(kind, location[:-1]))
        hint = suggest_key(str(location[-1]), known)
        yield Fault(_path(location), "an unknown key", f"one of {', '.join(known)}", hint)
    elif line["type"] in ("missing", "missing_argument"):
        yield Fault(_path(location), "nothing", "a value: the key is required")
    else:
        # prefixes of the library's sentences, which do not fit after our "expected"
        reason = str(line["msg"]).removeprefix("Value error, ").removeprefix("Input should be ")
        yield Fault(
            _path(location), short_repr(line["input"]), reason[:1].lower() + reason[1:].rstrip(".")
        )


def _known_keys(kind: Any, location: Sequence[object]) -> set[str]:
    """Return the field names of the dataclass at ``location`` inside ``kind``."""
    here = kind
    for part in location:
        if isinstance(part, str) and hasattr(here, "__dataclass_fields__"):
            here = typing.get_type_hints(here).get(part)
        elif isinstance(part, int):
            here = next(iter(typing.get_args(here)), None)
    return (
        {f.name for f in dataclass_fields(here)} if hasattr(here, "__dataclass_fields__") else set()
    )


def _replace_non_json(data: object, path: str, bad: list[Fault]) -> object:
    """Replace values that JSON cannot represent (NaN, dates) by null and list them in ``bad``."""
    if isinstance(data, dict):
        return {
            str(k): _replace_non_json(v, f"{path}.{k}" if path else str(k), bad)
            for k, v in data.items()
        }
    if isinstance(data, list | tuple):
        return [_replace_non_json(v, f"{path}[{i}]", bad) for i, v in enumerate(data)]
    if isinstance(data, float) and not math.isfinite(data):
        bad.append(Fault(path, short_repr(data), "a finite number"))
        return None
    if not isinstance(data, str | int | float | bool | None):
        bad.append(Fault(path, short_repr(data), "a number, text, list or table"))
        return None
    return data


def _count(faults: Sequence[Fault]) -> str:
    return "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
