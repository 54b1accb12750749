"""Everything of Weyrich et al. 2006 that a page shows: lobes, translucency, traits."""

from typing import Any

from skinrig.viewer.assets import albedo_traits as albedo_trait_assets
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets import traits as trait_assets
from skinrig.viewer.scene import Assets, SceneSource, Texture


def assets(source: SceneSource) -> Assets:
    """Return lobes with their shares, a diffusion profile, and trait sliders.

    Parameters
    ----------
    source
        A fitted appearance "model" or "dome" gives the face's own; others show the mean surface of
        the population that the packaged traits were learned from.

    Raises
    ------
    SkinReflectanceError, SurfaceMixtureError
        For a fitted folder that is damaged.
    """
    found = reflectance_assets.lobes_of(source)
    left_out: dict[str, str] = {}
    textures: dict[str, Texture] = {}
    facts: dict[str, Any] = {}
    names: list[str] = []
    surface = trait_assets.surface_traits(found)
    if surface is None:
        left_out["traits of the surface"] = (
            "the lobes were fitted with other materials than the traits were learned with"
        )
    else:
        found = surface.lobes
        facts["surface_traits"] = trait_assets.surface_facts(surface)
        names += surface.pull
    albedo = albedo_trait_assets.albedo_traits(source)
    if isinstance(albedo, str):
        left_out["traits of the albedo"] = albedo
    else:
        textures["albedo_traits"] = albedo.texture()
        facts["albedo_traits"] = albedo.facts()
        names += [name for name in albedo.names if name not in names]
    base = reflectance_assets.assemble(source, found)
    return {
        "textures": {**base["textures"], **textures},
        "params": {"traits": dict.fromkeys(names, 0.0)},
        "facts": {**base["facts"], **facts},
        "left_out": (*base["left_out"], *left_out.items()),
    }
