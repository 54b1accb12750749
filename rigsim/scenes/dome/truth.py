"""Assemble the dome's ground truth: the face's maps in a camera's image and on its texture."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from rigsim.light import olat, surface_brdf
from rigsim.light.olat import Hits
from rigsim.light.surface_brdf import SkinSurface
from rigsim.population.population import MAX_SKIN_HAIR
from rigsim.scenes.dome.rows import normalize
from rigsim.subject import SimulatedSubject

COATING_MAPS: Final = ("film", "film_alpha", "film_eta", "powder")
"""Names of a coating's maps, in the order of `SkinSurface.packed` (`rigsim.light.surface_brdf`)."""


def image_truth_maps(hits: Hits) -> dict[str, NDArray[np.generic]]:
    """Return the maps of `rigsim.scenes.dome.scene.DomeScene.truth`: pixel means, without lens."""
    surface = olat.unpack_surface(hits.surface)
    normals = normalize(hits.scatter(hits.normals()))
    maps = hits.scatter(surface)
    hair = hits.scatter(1.0 - surface[:, 6:7])[..., 0]
    coverage = hits.coverage()
    uv = hits.texture_uv()
    coating = dict(zip(COATING_MAPS, np.moveaxis(maps, -1, 0)[7:], strict=False))
    return {
        **coating,
        "r_d": maps[..., :3],
        "normals": normals,
        "position_mm": hits.scatter(hits.position_mm),
        "roughness": maps[..., 3],
        "oil": maps[..., 4],
        "fuzz": maps[..., 5],
        "uv": hits.scatter(uv),
        "hair": hair,
        "mask": (coverage > 1.0 - 1e-6) & (hair < MAX_SKIN_HAIR),
    }


def texture_truth(
    subject: SimulatedSubject,
    surface: SkinSurface,
    conditions: Mapping[str, float],
    *,
    omitted: tuple[tuple[str, str], ...],
    seed: int,
) -> SkinAppearance:
    """Return the ground truth on a face's own texture, see `rigsim.scenes.dome.scene.DomeScene`."""
    valid = subject.atlas.covered & (subject.hair < MAX_SKIN_HAIR)
    floor = np.zeros(valid.shape, np.float32)
    floor[valid] = surface_brdf.min_surface_reflection(surface.packed()[valid])
    white = "camera RGB over that of a perfect white, without hair"
    maps = {
        "position": (subject.atlas.position_mm, MAP_UNITS["position"], "rig frame"),
        "normals": (surface.normal, MAP_UNITS["normals"], "rig frame, with relief"),
        "r_d": (surface.r_d, "1", f"factor of the diffuse term, {white}"),
        "r_d_floor": (floor, "1", "smallest surface term in the unit of r_d, within 70 degrees"),
        "reflectance": (surface.reflectance, "1", f"at normal incidence, {white}"),
        "roughness": (surface.roughness, MAP_UNITS["roughness"], "Beckmann, skin below the oil"),
        "oil": (surface.oil, "1", "fraction covered by oil, GGX of half the roughness"),
        "fuzz": (surface.fuzz, "1", "optical depth of vellus hair"),
        "normals_tangent": (
            subject.tangent_normal(),
            "1",
            "texture frame, relief and wrinkles: +x along u, +y along v, +z off the mesh",
        ),
    }
    if surface.coating is not None:
        on = surface.coating
        maps |= {
            "film": (on.film, "1", "fraction of the surface under a film"),
            "film_alpha": (on.film_alpha, "1", "GGX alpha of the film"),
            "film_eta": (on.film_eta, "1", "refractive index of the film"),
            "powder": (on.powder, "1", "fraction of the surface under grains"),
        }
    if subject.rest is not None:
        where = "rig frame, the same skin before it moved"
        maps["position_at_rest"] = (subject.rest.atlas.position_mm, "mm", where)
    return SkinAppearance(
        {
            name: SkinMap(values, unit, valid=valid, description=text)
            for name, (values, unit, text) in maps.items()
        },
        "simulated",
        parameters={
            "preset": subject.preset,
            "subject_seed": subject.seed,
            "conditions": dict(conditions),
        },
        left_out=omitted,
        seed=seed,
    )
