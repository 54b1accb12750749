"""Derive valid texels, assumptions, digests and versions of an appearance."""

import hashlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig import consent
from skinrig.arrays import BoolArray

FUSION_KEY: Final = "fusion"
"""Key in `parameters` of a fused person: common properties and each map's rigs."""


def is_fused(appearance: SkinAppearance) -> bool:
    """Return whether `skinrig fuse` wrote an appearance."""
    return FUSION_KEY in appearance.parameters


def intersect_valid(*maps: SkinMap) -> BoolArray:
    """Return the texels that are valid in all given maps of one size, (H, W).

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
    """Return the assumptions of an appearance, one text each."""
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
    """Create an appearance with the provenance of its sources.

    Parameters
    ----------
    sources
        One or more sources. The result is simulated if one of them is. It records the consent of
        all subjects, and the seed of the first source.
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
    """Return the versions of the distributions that compute maps."""
    return {name: metadata.version(name) for name in ("skinrig", "numpy", "scipy", "numba")}
