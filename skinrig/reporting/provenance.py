"""What a map was made of, by what, with which settings, and what was left out: as tables."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from model.skin import SkinAppearance
from skinrig.reporting import page

DIGEST_CHARS = 16
"""Characters of a digest that a table shows."""


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings by their path, as text.

    Examples
    --------
    >>> flattened({"fit": {"rank": 4, "seed": None}, "views": [1, 2]})
    {'fit.rank': '4', 'fit.seed': 'null', 'views': '[1, 2]'}
    """
    flat: dict[str, str] = {}
    for key, value in sorted(values.items()):
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat |= flattened(value, f"{name}.")
        elif isinstance(value, (list, tuple)) and len(json.dumps(value)) > 120:
            flat[name] = f"{len(value)} entries"
        else:
            flat[name] = value if isinstance(value, str) else json.dumps(value)
    return flat


def section(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield what was assumed and left out, and where an appearance comes from."""
    assumed = appearance.parameters.get("assumed")
    if isinstance(assumed, (list, tuple)) and assumed:
        yield page.Heading("Assumed")
        yield page.assumptions(assumed)
    if appearance.left_out:
        yield page.Heading("Left out")
        yield page.table(("what", "why"), appearance.left_out, caption="Stages that were not run")
    yield page.Heading("Provenance")
    yield page.facts(
        {"source": appearance.source, "seed": str(appearance.seed)}
        | {f"input {k}": short(v) for k, v in sorted(appearance.inputs.items())}
        | {f"version of {k}": v for k, v in sorted(appearance.versions.items())},
        caption=f"Inputs by the first {DIGEST_CHARS} digits of their SHA-256",
    )
    settings = {
        name: value
        for name, value in flattened(appearance.parameters).items()
        if not name.startswith(("stages.", "assumed"))
    }
    told = page.facts(settings, caption="Parameters that the folder records")
    yield page.Folded(f"{len(settings)} parameters", [told])


def short(digest: str) -> str:
    """Return the beginning of a digest, which tells two apart.

    Examples
    --------
    >>> short("sha256:0123456789abcdef0123")
    '0123456789abcdef'
    """
    return digest.removeprefix("sha256:")[:DIGEST_CHARS]
