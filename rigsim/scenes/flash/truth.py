"""Assemble the flash rig's ground truth: the face's maps in its camera's image.

The maps are described at `rigsim.scenes.flash.scene.FlashScene.truth`.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig
from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array
from rigsim.light.observed_skin import observe_skin
from rigsim.light.subsurface_radiance import inner_albedo
from rigsim.population.population import MAX_SKIN_HAIR
from rigsim.scenes.flash.image import FlashCamera, FlashImage
from rigsim.scenes.flash.surfaces import FlashSurface
from rigsim.subject import SimulatedSubject

MAX_FOREIGN_LIGHT_FRACTION: Final = 0.01
"""Pixels that receive more than this fraction of their light from off the skin are not skin."""

BLURRED_MAPS: Final = ("reflectance", "melanin", "hemoglobin")
"""Maps that lateral scattering in the skin blurs."""

VOLUME_FRACTIONS: Final = ("melanin", "hemoglobin")
BLURRED_FRACTIONS: Final = ("melanin_blurred", "hemoglobin_blurred")


def truth_maps(
    image: FlashImage,
    blurred: Mapping[str, Float32Array],
    *,
    shading: Float32Array,
    white_rgb: Float32Array,
) -> dict[str, NDArray[np.generic]]:
    """Return the maps of a face in its present pose.

    Parameters
    ----------
    image
        Image of the face.
    blurred
        Maps after lateral scattering in the skin, by name, see `FlashCamera.blurred_maps`.
    shading
        (H, W[, 3]), the image's shading through the crossed analyzer.
    white_rgb
        (3,), camera RGB of the white reference, fraction of full scale.
    """
    maps: dict[str, NDArray[np.generic]] = {**image.maps, **blurred}
    maps["shading"] = shading
    maps["diffuse"] = image.diffuse[:, :, 0] * white_rgb
    maps["specular"] = image.specular[:, :, :1] * white_rgb
    maps["mask"] = fully_skin_pixels(image)
    return maps


def unblurred_maps(
    image: FlashImage, names: Sequence[str] = BLURRED_MAPS
) -> dict[str, Float32Array]:
    """Return maps of a face without lateral scattering, under the names of blurred ones."""
    return {f"{name}_blurred": image.maps[name] for name in names}


def truth_maps_at_rest(
    camera: FlashCamera,
    surface: FlashSurface,
    moved: SimulatedSubject,
    state: str,
    blurred: Mapping[str, Float32Array] | None = None,
) -> dict[str, NDArray[np.generic]]:
    """Return the fractions of a state mapped onto the face at rest.

    Parameters
    ----------
    camera
        Camera of the face at rest.
    surface
        Its surface.
    moved
        The face in its pose, or at rest.
    state
        State of its blood.
    blurred
        Textures of the moved face, see `FlashCamera.blurred_maps`: light scatters in the moved
        face, wherever the skin is then mapped. None: without lateral scattering.
    """
    rest = moved if moved.rest is None else moved.rest
    layers = {"melanin": rest.melanin, "hemoglobin": moved.hemoglobin(state), "hair": rest.hair}
    if blurred is not None:
        layers |= {name: blurred[name] for name in BLURRED_FRACTIONS}
    picture = camera.observe_maps(surface, rest, layers)
    seen = dict(picture.maps)
    if blurred is None:
        seen |= unblurred_maps(picture, VOLUME_FRACTIONS)
    maps = {f"{name}_at_rest": seen[name] for name in (*VOLUME_FRACTIONS, *BLURRED_FRACTIONS)}
    return {**maps, "mask_at_rest": fully_skin_pixels(picture)}


def rest_maps_of_unmoved_face(
    maps: Mapping[str, NDArray[np.generic]],
) -> dict[str, NDArray[np.generic]]:
    """Return the same maps for a face that has not moved, from those of `truth_maps`."""
    return {
        f"{name}_at_rest": maps[name] for name in (*VOLUME_FRACTIONS, *BLURRED_FRACTIONS, "mask")
    }


def face_surface(
    face: SimulatedSubject, state: str, rig: Rig, white_rgb: Float32Array
) -> dict[str, NDArray[np.generic]]:
    """Return a face for other renderers, as the rig's first camera observes it.

    Parameters
    ----------
    face
        The face in its pose.
    state
        State of its blood.
    rig
        The rig: the camera's sensitivities and the lights' spectrum.
    white_rgb
        See `FlashScene.white_rgb`.

    Returns
    -------
    dict
        ``vertices_mm``, ``faces`` and ``uv``: the mesh in its pose. Textures of shape (N, N[, 3]),
        float32: ``r_d``, the light that leaves skin or hair over that which enters; ``roughness``,
        GGX alpha; ``bare``, fraction not behind hair; ``normals``, unit, rig frame, with relief.
        ``white_rgb``: as given.
    """
    camera, illuminant = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    skin = observe_skin(face, state, camera, illuminant)
    return {
        "vertices_mm": face.mesh.vertices_mm,
        "faces": face.mesh.faces,
        "uv": face.mesh.uv,
        "r_d": inner_albedo(face, skin.reflectance()),
        "roughness": np.clip(face.roughness, *shading.ALPHA_RANGE),
        "bare": np.float32(1.0) - face.hair,
        "normals": face.normal,
        "white_rgb": white_rgb,
    }


def fully_skin_pixels(image: FlashImage) -> BoolArray:
    """Return the pixels, (H, W), that are wholly on skin and receive light from skin only."""
    whole = (image.coverage > 1.0 - 1e-6) & (
        image.surface_fraction > 1.0 - MAX_FOREIGN_LIGHT_FRACTION
    )
    return whole & (image.maps["hair"] < MAX_SKIN_HAIR)
