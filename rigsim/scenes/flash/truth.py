"""What an estimator should find before the flash rig: the face's maps as its camera sees them.

The maps are described at `rigsim.scenes.flash.scene.FlashScene.truth`.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigsim.arrays import BoolArray, Float32Array
from rigsim.population.population import MAX_SKIN_HAIR
from rigsim.render import Caster
from rigsim.scenes.flash.image import Look, Picture
from rigsim.subject import SimulatedSubject

MAX_FOREIGN_LIGHT: Final = 0.01
"""Pixels that get more of their light than this from off the skin, by the lens, are not skin."""

BLURRED_MAPS: Final = ("reflectance", "melanin", "hemoglobin")
"""Maps that the spreading of light in the skin blurs."""

VOLUME_FRACTIONS: Final = ("melanin", "hemoglobin")
BLURRED_FRACTIONS: Final = ("melanin_blurred", "hemoglobin_blurred")


def maps_of(
    picture: Picture,
    blurred: Mapping[str, Float32Array],
    *,
    shading: Float32Array,
    white_rgb: Float32Array,
) -> dict[str, NDArray[np.generic]]:
    """Return the maps of a face as it stands.

    Parameters
    ----------
    picture
        The face as the camera sees it.
    blurred
        Maps as light spreads in the skin, by name, see `Look.blurred_maps`.
    shading
        (H, W[, 3]), the picture's shading through the crossed analyser.
    white_rgb
        (3,), camera RGB of the white reference, fraction of full scale.
    """
    maps: dict[str, NDArray[np.generic]] = {**picture.maps, **blurred}
    maps["shading"] = shading
    maps["diffuse"] = picture.diffuse[:, :, 0] * white_rgb
    maps["specular"] = picture.specular[:, :, :1] * white_rgb
    maps["mask"] = whole_skin(picture)
    return maps


def unblurred_maps(
    picture: Picture, names: Sequence[str] = BLURRED_MAPS
) -> dict[str, Float32Array]:
    """Return maps of a face in which light does not spread, under the names of blurred ones."""
    return {f"{name}_blurred": picture.maps[name] for name in names}


def maps_at_rest(
    look: Look,
    caster: Caster,
    rest: SimulatedSubject,
    state: str,
    spread: Mapping[str, Float32Array] | None = None,
) -> dict[str, NDArray[np.generic]]:
    """Return the fractions of a state as seen on the face at rest.

    Parameters
    ----------
    look
        How the face at rest is looked at.
    caster
        That of its mesh.
    rest
        The face as it is before it moves.
    state
        Whose blood it has.
    spread
        Textures of the moved face, see `Look.blurred_maps`: light spreads on that, wherever the
        skin is then looked for. None: light does not spread.
    """
    layers = {"melanin": rest.melanin, "hemoglobin": rest.hemoglobin(state), "hair": rest.hair}
    if spread is not None:
        layers |= {name: spread[name] for name in BLURRED_FRACTIONS}
    picture = look.at_maps(caster, rest, layers)
    seen = dict(picture.maps)
    if spread is None:
        seen |= unblurred_maps(picture, VOLUME_FRACTIONS)
    maps = {f"{name}_at_rest": seen[name] for name in (*VOLUME_FRACTIONS, *BLURRED_FRACTIONS)}
    return {**maps, "mask_at_rest": whole_skin(picture)}


def unmoved_maps(maps: Mapping[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """Return the same maps of a face that has not moved, from those of `maps_of`."""
    return {
        f"{name}_at_rest": maps[name] for name in (*VOLUME_FRACTIONS, *BLURRED_FRACTIONS, "mask")
    }


def whole_skin(picture: Picture) -> BoolArray:
    """Return the pixels, (H, W), that are wholly on skin, and get light from there alone."""
    whole = (picture.coverage > 1.0 - 1e-6) & (picture.reached > 1.0 - MAX_FOREIGN_LIGHT)
    return whole & (picture.maps["hair"] < MAX_SKIN_HAIR)
