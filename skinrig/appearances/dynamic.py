"""Read and write dynamic appearances: facial color, wrinkles and microstructure in one folder.

Each fit adds its part to the folder and replaces an older part of the same kind; others are kept.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from model import store
from model.skin import SkinAppearance
from skinrig.appearances.contents import is_fused, list_versions

DYNAMIC_KIND = "dynamic"
FACIAL_COLOR, WRINKLES, MICROSTRUCTURE = "facial_color", "wrinkles", "microstructure"
DYNAMIC_PARTS = (FACIAL_COLOR, WRINKLES, MICROSTRUCTURE)
FIT_COMMANDS: Mapping[str, str] = {
    FACIAL_COLOR: "skinrig fit facial-color",
    WRINKLES: "skinrig fit wrinkles",
    MICROSTRUCTURE: "skinrig fit microstructure",
}


class DynamicAppearanceError(ValueError):
    """A folder without dynamic parts, or with maps of another kind."""


def check_target(out: Path) -> None:
    """Raise if the output folder of a fit is not usable, before the fit is computed.

    Raises
    ------
        DynamicAppearanceError
    *        If ``out`` has maps of another kind.
    """
    _previous(out)


def add(out: Path, name: str, part: SkinAppearance) -> SkinAppearance:
    """Add a fitted part to a dynamic appearance.

    Parameters
    ----------
        out
            The folder; created if missing.
        name
            Name of the part, of `DYNAMIC_PARTS`.
        part
            The fitted model with its maps, files, settings and figures.

    Raises
    ------
        DynamicAppearanceError
    *        If ``out`` has maps of another kind, or another part has a map of the same name.
    """
    previous = _previous(out) or SkinAppearance({}, part.source)
    parts = {other: entry for other, entry in describe_parts(previous).items() if other != name}
    maps = {key: previous.maps[key] for entry in parts.values() for key in entry["maps"]}
    files = {key: previous.files[key] for entry in parts.values() for key in entry["files"]}
    sources = {part.source, *(str(entry["source"]) for entry in parts.values())}
    inputs = {k: v for k, v in previous.inputs.items() if k.partition(": ")[0] in parts}
    left_out = [row for row in previous.left_out if row[0].partition(": ")[0] in parts]
    double = sorted({*maps, *files} & {*part.maps, *part.files})
    if double:
        raise DynamicAppearanceError(
            f"{double[0]}: another part of {out} has a map of that name; name another --out"
        )
    parts[name] = {
        "maps": sorted(part.maps),
        "files": sorted(part.files),
        "source": part.source,
        **part.parameters,
    }
    appearance = SkinAppearance(
        maps={**maps, **part.maps},
        source="simulated" if "simulated" in sources else "measured",
        parameters={"kind": DYNAMIC_KIND, "parts": parts},
        inputs={**inputs, **{f"{name}: {key}": value for key, value in part.inputs.items()}},
        versions=list_versions(),
        left_out=(*left_out, *((f"{name}: {what}", why) for what, why in part.left_out)),
        files={**files, **part.files},
        seed=previous.seed if part.seed is None else part.seed,
    )
    store.write(out, appearance)
    return appearance


def read(
    path: Path, *, parts: Sequence[str] = DYNAMIC_PARTS
) -> tuple[SkinAppearance, dict[str, Any]]:
    """Read a dynamic appearance, or a fused person, and the documents of its parts.

    Parameters
    ----------
    path
        The folder.
    parts
        Parts of which at least one is required.

    Raises
    ------
    DynamicAppearanceError
        If it has none of them.
    """
    appearance = store.read(path)
    has_parts = appearance.parameters.get("kind") == DYNAMIC_KIND or is_fused(appearance)
    found = describe_parts(appearance) if has_parts else {}
    if not set(parts) & set(found):
        commands = " or ".join(f"`{FIT_COMMANDS[name]}`" for name in parts)
        raise DynamicAppearanceError(
            f"{path}: got {', '.join(found) or 'maps without fitted parts'}, expected "
            f"{' or '.join(parts)}; {commands} makes it [SR-REC-022]"
        )
    return appearance, found


def _previous(out: Path) -> SkinAppearance | None:
    if not (out / store.DOCUMENT_FILE).is_file():
        return None
    kind = store.read_document(out).parameters.get("kind")
    if kind != DYNAMIC_KIND:
        raise DynamicAppearanceError(
            f"{out}: holds maps of kind {kind!r}, expected a new folder or one that a fit wrote; "
            "it was not changed; name another with --out"
        )
    return store.read(out)


def describe_parts(appearance: SkinAppearance) -> dict[str, Any]:
    """Return the documents of an appearance's parts by name; empty without parts."""
    parts = appearance.parameters.get("parts")
    return dict(parts) if isinstance(parts, dict) else {}
