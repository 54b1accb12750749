"""Shared readers of an appearance: valid texels, assumptions, digest and versions."""

import hashlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig import consent
from skinrig.arrays import BoolArray


def intersect_valid(*maps: SkinMap) -> BoolArray:
    """Return the texels that are valid in all of some maps of one size, (H, W).

    Examples
    --------
    >>> whole = SkinMap(np.zeros((1, 2), np.float32), "1")
    >>> half = SkinMap(whole.values, "1", valid=np.array([[True, False]]))
    >>> intersect_valid(whole, half).tolist()
    [[True, False]]
    """
    good = np.ones(maps[0].values.shape[:2], np.bool_)
    for one in maps:
        good &= True if one.valid is None else one.valid
    return good


def list_assumptions(appearance: SkinAppearance) -> list[str]:
    """Return what an appearance takes for granted, a text each."""
    texts = appearance.parameters.get("assumed", ())
    return [str(text) for text in texts] if isinstance(texts, list | tuple) else []


def hash_document(folder: Path) -> str:
    """Return the SHA-256 of an APPEARANCE/ folder's document."""
    return hash_file(folder / store.DOCUMENT_FILE)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def derive_appearance(
    *sources: SkinAppearance,
    maps: Mapping[str, SkinMap],
    parameters: Mapping[str, object],
    **more: Any,
) -> SkinAppearance:
    """Return an appearance with the provenance of those that it is made of.

    Parameters
    ----------
    sources
        One or more. The result is simulated where one of them is, records what all their subjects
        agreed to, and has the seed of the first.
    maps, parameters, more
        Fields of the appearance.
    """
    agreed = {consent.CONSENT_KEY: consent.merge_consent(*sources)}
    return SkinAppearance(
        maps,
        "simulated" if any(one.source == "simulated" for one in sources) else "measured",
        {**parameters, **agreed},
        versions=list_versions(),
        **{"seed": sources[0].seed, **more},
    )


def list_versions() -> dict[str, str]:
    """Return the versions of what computes maps, by distribution."""
    return {name: metadata.version(name) for name in ("skinrig", "numpy", "scipy", "numba")}
