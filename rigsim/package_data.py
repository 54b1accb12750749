"""Read the tables in the package's folder ``data``."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def package_table(name: str) -> dict[str, Any]:
    """Return a TOML table of the package, its arrays as tuples."""
    text = (files("rigsim") / "data" / f"{name}.toml").read_text("utf-8")
    return {key: _fixed(value) for key, value in tomllib.loads(text).items()}


def _fixed(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_fixed(part) for part in value)
    if isinstance(value, dict):
        return {key: _fixed(part) for key, part in value.items()}
    return value
