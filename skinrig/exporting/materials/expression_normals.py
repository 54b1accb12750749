"""Convert measured wrinkles to one normal map per expression, in the frames of a material's mesh.

Scene formats switch normal maps, but do not blend them by zone. An expression is therefore a
variant of the material: its wrinkles at weight 1.
"""

from typing import Final

import numpy as np

from model import wrinkles
from model.skin import SkinAppearance
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from skinrig.appearances.dynamic import WRINKLES, describe_parts
from skinrig.arrays import Float32Array
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportError

NEUTRAL_VARIANT: Final = "neutral"
"""Name of the variant without wrinkles."""
VARIANT_NOTE: Final = (
    "wrinkles of the expression at weight 1: slopes of its wrinkles are added to those of the "
    "neutral normal map; the mesh moves by blend shapes alone"
)


def expression_normals(appearance: SkinAppearance, material: Material) -> dict[str, Float32Array]:
    """Return the tangent-space normals of each expression with fitted wrinkles.

    Parameters
    ----------
    appearance
        Maps of the face.
    material
        Its material; both frames have x along u and y along v, so that slopes add.

    Returns
    -------
    dict of str to ndarray of float32
        Unit normals (H, W, 3), +Y up, by expression; empty without wrinkles. A texel without a
        measured wrinkle keeps the neutral normal.

    Raises
    ------
    ExportError
        If the wrinkles have another size.
    """
    part = describe_parts(appearance).get(WRINKLES)
    if part is None:
        return {}
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    neutral = wrinkles.encode(material.normals.astype(np.float64), limit=None)
    found = {}
    for name in part["expressions"]:
        shown = model.evaluate({str(name): 1.0})
        moved = wrinkles.encode(shown.normals.astype(np.float64), limit=None) - model.base
        moved = np.where(shown.valid[..., None], moved, 0.0)
        if moved.shape != neutral.shape:
            raise ExportError(
                f"wrinkles of {name}: got {moved.shape[:2]} texels, expected the normals' "
                f"{neutral.shape[:2]}; fit them to maps of this size"
            )
        found[str(name)] = wrinkles.decode(neutral + moved).astype(np.float32)
    return found
