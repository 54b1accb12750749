"""Read error codes and their message templates from the source, without importing it.

A code is written where its error is raised: at the end of the text, ``"...; do Z [SR-CAP-012]"``,
or as the keyword ``code`` of a structured error. The reference page and a test use this module.
"""

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

CODE = re.compile(r"SR-[A-Z]{3}-\d{3}")
AREAS = {
    "CAL": "Calibration",
    "CAP": "Capture and devices",
    "CLI": "Command line",
    "ENV": "Installation",
    "EXP": "Export",
    "IMP": "Import",
    "PLN": "Plans and rig files",
    "REC": "Reconstruction",
    "SES": "Sessions",
    "SIM": "Simulation",
}
_ENDING = re.compile(rf"(.*) \[({CODE.pattern})\]", re.DOTALL)
_FIELD = "..."


@dataclass(frozen=True, slots=True)
class ErrorText:
    """Message of one raise site: its code, its template, and its file."""

    code: str
    template: str
    """Text without the code, on one line; fields that are filled in are three dots."""
    path: str


def read_error_texts(root: Path, packages: Iterable[str]) -> list[ErrorText]:
    """Return all coded messages of the packages below ``root``, sorted by code."""
    found = [
        ErrorText(code, template, path.relative_to(root).as_posix())
        for package in packages
        for path in sorted((root / package).rglob("*.py"))
        if CODE.search(text := path.read_text("utf-8"))
        for code, template in error_texts_of(ast.parse(text))
    ]
    return sorted(found, key=lambda one: (one.code, one.path))


def error_texts_of(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield code and template of each coded message in a module.

    Examples
    --------
    >>> source = 'raise ValueError(f"{name}: got {x}, expected 1; correct it [SR-CLI-000]")'
    >>> list(error_texts_of(ast.parse(source)))
    [('SR-CLI-000', '...: got ..., expected 1; correct it')]
    >>> source = 'raise E("is closed", where=w, advice="Start a new one.", code="SR-SES-000")'
    >>> list(error_texts_of(ast.parse(source)))
    [('SR-SES-000', '...: is closed; Start a new one.')]
    """
    yield from _walk(tree, {})


def _walk(node: ast.AST, names: dict[str, ast.expr]) -> Iterator[tuple[str, str]]:
    """Yield the messages below a node; ``names`` holds the last value assigned to each name."""
    if isinstance(node, ast.FunctionDef):
        names = dict(names)
    if isinstance(node, ast.Assign):
        names.update(_assignments(node))
    if isinstance(node, ast.JoinedStr | ast.Constant):
        match = _ENDING.fullmatch(_render(node, names))
        if match:
            yield match[2], _one_line(match[1])
        return  # the parts of a joined string are not messages
    if isinstance(node, ast.Call):
        code = next((_render(k.value, names) for k in node.keywords if k.arg == "code"), "")
        if CODE.fullmatch(code):
            yield code, _call_template(node, names)
    for child in ast.iter_child_nodes(node):
        yield from _walk(child, names)


def _assignments(node: ast.Assign) -> Iterator[tuple[str, ast.expr]]:
    target = node.targets[0]
    if isinstance(target, ast.Name):
        yield target.id, node.value
    elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
        for one, value in zip(target.elts, node.value.elts, strict=True):
            if isinstance(one, ast.Name):
                yield one.id, value


def _render(node: ast.expr, names: dict[str, ast.expr]) -> str:
    """Return the text of an expression; what is not a literal becomes three dots."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else _FIELD
    if isinstance(node, ast.JoinedStr):
        return "".join(
            _render(part, {}) if isinstance(part, ast.Constant) else _FIELD for part in node.values
        )
    if isinstance(node, ast.Name) and isinstance(names.get(node.id), ast.Constant | ast.JoinedStr):
        return _render(names[node.id], {})
    return _FIELD


def _call_template(call: ast.Call, names: dict[str, ast.expr]) -> str:
    """Return the template of a structured error: place, fault, got, expected, advice."""
    keywords = {k.arg: k.value for k in call.keywords}
    texts = [_render(node, names) for node in call.args if not isinstance(node, ast.Starred)]
    if isinstance(call.func, ast.Attribute) and call.func.attr == "at":
        what, path, got, expected = texts
        texts = [f"{what}: {_format_fault(path, got, expected)}"]
    else:  # a class is an argument of functions that raise it
        texts = [text for text in texts if text != _FIELD][:1] or [_FIELD]
        texts += _faults(keywords.get("faults"), names)
    if "advice" in keywords:
        texts.append(_render(keywords["advice"], names))
    where = f"{_FIELD}: " if "where" in keywords else ""
    return _one_line(where + "; ".join(texts))


def _faults(node: ast.expr | None, names: dict[str, ast.expr]) -> list[str]:
    if isinstance(node, ast.Name):
        node = names.get(node.id)
    rows = node.elts if isinstance(node, ast.List) else []
    return [
        _format_fault(*(_render(part, names) for part in row.args[:3]))
        for row in rows
        if isinstance(row, ast.Call) and len(row.args) >= 3
    ]


def _format_fault(path: str, got: str, expected: str) -> str:
    return f"{path}: got {got}, expected {expected}"


def _one_line(text: str) -> str:
    return " ".join(text.split())
