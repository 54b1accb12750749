"""From what is known of a face to a scene: every asset builder adds its part."""

from collections.abc import Callable
from typing import Any, Final

from skinrig.viewer import presets
from skinrig.viewer.assets import facial_color as facial_color_assets
from skinrig.viewer.assets import fitted as fitted_assets
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets import surface as surface_assets
from skinrig.viewer.assets import wrinkles as wrinkle_assets
from skinrig.viewer.microstructure import assets as microstructure_assets
from skinrig.viewer.scene import Assets, SceneSource, ViewerScene

ASSET_BUILDERS: Final[tuple[Callable[[SceneSource], Assets], ...]] = (
    facial_color_assets.assets,
    reflectance_assets.default_scattering,
    surface_assets.assets,
    fitted_assets.assets,
    wrinkle_assets.assets,
    microstructure_assets.assets,
)
"""In the order in which their parts are listed; they do not see each other's."""


def assemble(source: SceneSource, *, provenance: dict[str, Any] | None = None) -> ViewerScene:
    """Return the scene of a source."""
    scene = ViewerScene(mesh=source.mesh, provenance=provenance or {})
    for build in ASSET_BUILDERS:
        scene = scene.with_assets(build(source))
    return scene.with_assets(presets.assets(scene))
