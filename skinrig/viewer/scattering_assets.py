"""How far light spreads in the skin, as a sum of Gaussians for the screen."""

from __future__ import annotations

from skinrig.viewer.scene import Assets, SceneSource

# Placeholder figures until the fit of the scene's own profile is in: d'Eon and Luebke's skin
# shares the same form (variances in mm^2, weights of red, green and blue).
_VARIANCES_MM2 = (0.0484, 0.187, 0.567, 1.99)
_WEIGHTS = ((0.333, 0.791, 0.993), (0.118, 0.198, 0.007), (0.191, 0.007, 0.0), (0.358, 0.004, 0.0))


def assets(source: SceneSource) -> Assets:
    """Return variances and weights of the Gaussians."""
    return {
        "facts": {
            "scattering": {
                "variances_mm2": list(_VARIANCES_MM2),
                "weights": [list(row) for row in _WEIGHTS],
            }
        }
    }
