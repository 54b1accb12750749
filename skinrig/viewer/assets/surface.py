"""The static surface: relief of pores and lines, roughness and strength of the reflection."""

from typing import Final

import numpy as np

from skinrig.viewer.map_filling import filled, halved
from skinrig.viewer.scene import Assets, SceneSource, Texture

MAPS_PX: Final = 256
"""Most texels a side of roughness and intensity, which vary by region."""
FINEST_STEP_WORDS: Final = 20
"""Words of the finest octave's steps, of reliefs of 2048 texels a side and more: 5 um at most."""


def assets(source: SceneSource) -> Assets:
    """Return the relief at rest, um, and roughness (Beckmann m) and intensity by region."""
    subject = source.subject
    covered = subject.atlas.covered
    height = source.skin.height_um()[..., None]
    # Beckmann's m and GGX's alpha give a peak of the same height, 1 / (pi m^2)
    roughness = halved(filled(subject.roughness, covered), MAPS_PX)
    # hair hides the skin's gloss, as the subject's own renderings have it
    intensity = 1.0 - halved(filled(subject.hair, covered), MAPS_PX)
    maps = np.stack([roughness, intensity], axis=-1)
    why = "what is drawn of them is simulated; the analytic reflection uses it"
    captured = source.kind in ("dynamic", "dome", "model")
    fine = FINEST_STEP_WORDS if len(height) >= 2048 else 1
    return {
        "textures": {
            "relief_height": Texture(height.astype(np.float32), "u8", "mipmap", fine=fine),
            "surface_maps": Texture(maps.astype(np.float32), "u8"),
        },
        "left_out": (("pores and roughness of this face", why),) if captured else (),
    }
