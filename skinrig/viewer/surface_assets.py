"""The static surface: slopes of pores and lines, roughness and strength of the reflection."""

from __future__ import annotations

import numpy as np

from skinrig.viewer.facial_color_assets import filled
from skinrig.viewer.scene import Assets, SceneSource, Texture


def assets(source: SceneSource) -> Assets:
    """Return slopes of the relief at rest, and the surface's roughness, of a simulated face."""
    subject = source.subject
    if subject is None:
        return {"left_out": (("relief", "nothing of the surface was measured"),)}
    covered = subject.atlas.covered
    normal = subject.tangent_normal().astype(np.float64)
    slopes = -normal[..., :2] / np.maximum(normal[..., 2:], 0.2)
    slopes = np.stack([filled(slopes[..., c], covered) for c in range(2)], axis=-1)
    step = max(1, subject.size // 256)
    roughness = filled(subject.roughness, covered)[::step, ::step]
    maps = np.stack([roughness, np.ones_like(roughness)], axis=-1)
    return {
        "textures": {
            "relief_slopes": Texture(slopes.astype(np.float32), "u8"),
            "surface_maps": Texture(maps.astype(np.float32), "u8"),
        }
    }
