"""Build the page's wrinkle and relief assets: base derivatives, wrinkle maps, zones and weights.

Maps are those of `model.wrinkles.evaluation`: from `skinrig fit wrinkles` if a folder has them,
else fitted to the simulated person's own expressions. The page combines them as
`model.wrinkles.combine_layers` does.
"""

from typing import Any, Final

import numpy as np

from model.texture_resampling import resample
from model.wrinkles import WrinkleLayer, decode, encode, mask_textures
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import as_table
from reconstruction.wrinkles.fit import fit_wrinkle_map
from reconstruction.wrinkles.zones import estimate_amplitudes, fit_zones
from rigsim.subject import SimulatedSubject, make_subject
from rigsim.subject.expressions import EXPRESSION_STRENGTHS
from skinrig.arrays import Float32Array, Float64Array, FloatArray
from skinrig.viewer.map_filling import downsample, fill_holes
from skinrig.viewer.scene import Assets, SceneError, SceneSource, Texture

MAP_PX: Final = 512
"""Maximum side of wrinkle maps: texels of 0.5 mm on a face; the paper has 256."""
MASK_PX: Final = 64
WEIGHTS_PX: Final = 128
"""Side of the normals to which the zones' weights are fitted."""
ZONES_PER_LAYER: Final = 8
"""Zones per wrinkle map, in two RGBA textures."""
MAX_LAYERS: Final = 4
"""Maximum number of wrinkle maps of the shader."""


def build_assets(source: SceneSource) -> Assets:
    """Build the wrinkles of a scene: fitted ones, else those of the simulated person."""
    dynamic = source.appearances.get("dynamic")
    if dynamic is not None and WRINKLE_FILE in dynamic.files:
        found = WrinkleModel.from_maps(dynamic.maps, bytes(dynamic.files[WRINKLE_FILE]))
        return build_model_assets(found, source, origin="fitted")
    found = fit_simulated_wrinkles(source.subject, size=min(source.size, MAP_PX))
    return build_model_assets(
        found, source, origin="simulated: fitted to the person's own expressions"
    )


def fit_simulated_wrinkles(subject: SimulatedSubject, *, size: int) -> WrinkleModel:
    """Fit wrinkles to the expressions of a simulated person.

    Parameters
    ----------
    subject : Subject
        Neutral or posed person; its mesh, seed and preset are used.
    size : int
        Side of the fitted normals and of the wrinkle map, texels.
    """
    rest = subject if subject.rest is None else subject.rest
    if rest.size != size:
        rest = make_subject(rest.preset, seed=rest.seed, size=size, mesh=rest.mesh)
    neutral = rest.tangent_normal()
    posed = {state: rest.with_expression(state).tangent_normal() for state in EXPRESSION_STRENGTHS}
    few = min(MASK_PX, size)
    moved = estimate_amplitudes(neutral, posed, size=(few, few))
    rng = np.random.default_rng(subject.seed)
    zones = fit_zones(moved, zones=ZONES_PER_LAYER, rng=rng)
    # weights hardly depend on detail: they are fitted to coarse normals, then the map to fine ones
    coarse = (min(WEIGHTS_PX, size),) * 2
    small = {name: _downsample_normals(normals, coarse) for name, normals in posed.items()}
    rough = fit_wrinkle_map(_downsample_normals(neutral, coarse), small, zones.masks, size=coarse)
    table = as_table(rough.model().layers[0].table)
    return fit_wrinkle_map(neutral, posed, zones.masks, size=(size, size), table=table).model()


def _downsample_normals(normals: Float32Array, shape: tuple[int, int]) -> Float32Array:
    planes = np.moveaxis(encode(normals, limit=None), 2, 0)
    return np.asarray(decode(np.moveaxis(resample(planes, shape), 0, 2)), np.float32)


def build_model_assets(model: WrinkleModel, source: SceneSource, *, origin: str) -> Assets:
    """Build textures and facts of a wrinkle model on a scene's mesh.

    The neutral base of a simulated face is in `build_surface_assets`; a fitted base replaces it.

    Raises
    ------
    SceneError
        If there are more maps than `MAX_LAYERS`.
    """
    if len(model.layers) > MAX_LAYERS:
        raise SceneError(
            f"layers: got {len(model.layers)} wrinkle maps, expected at most {MAX_LAYERS}; fit "
            "fewer"
        )
    tables = [as_table(layer.table) for layer in model.layers]
    driven = sorted({name for table in tables for name in table.rows} & set(source.mesh.shapes))
    if not driven:
        rows = ", ".join(tables[0].rows) if tables else "none"
        why = f"the mesh has no blend shape of their expressions ({rows})"
        return Assets(left_out=(("wrinkles", why),))
    shape = _map_shape(model)
    maps = np.stack([_plane(layer.wrinkle, shape) for layer in model.layers])
    textures = {
        "wrinkle_maps": Texture(maps, "u16"),
        "wrinkle_masks": Texture(_masks(model.layers), "u8"),
    }
    if origin == "fitted":
        valid = np.ones(model.base.shape[:2], bool) if model.valid is None else model.valid
        textures["wrinkle_base"] = Texture(fill_holes(model.base, valid).astype(np.float32), "u8")
    layers = [
        {"zones": list(table.zones), "rows": {n: list(table.rows[n]) for n in sorted(table.rows)}}
        for table in tables
    ]
    facts: dict[str, Any] = {"expressions": driven, "layers": layers}
    facts |= {
        "clamp": model.clamp,
        "origin": origin,
        "slope_rms": compute_retained_rms(model, shape),
    }
    return Assets(textures=textures, facts={"wrinkles": facts})


def compute_retained_rms(model: WrinkleModel, shape: tuple[int, int]) -> list[list[float]]:
    """Return the RMS of slopes resolved by pixels of 2^level texels, by zone and level.

    It is that of each zone's part of its wrinkle map at weight 1, over texels with wrinkles. The
    error of omitting wrinkles in a view is at most this times the zone's weight times the largest
    derivative of the reflection by a slope.

    Parameters
    ----------
    model : WrinkleModel
    shape : (int, int)
        Shape of the page's maps, level 0.

    Returns
    -------
    list of list of float
        Eight zones per layer; levels down to one texel.
    """
    found = []
    for layer in model.layers:
        wrinkle = _plane(layer.wrinkle, shape).astype(np.float64)
        count = max(int(np.count_nonzero((wrinkle != 0).any(axis=2))), 1)
        masks = resample(np.asarray(layer.masks, np.float64), shape)
        rows = [_level_rms(mask[..., None] * wrinkle, count) for mask in masks]
        found += rows + [[0.0] * len(rows[0])] * (ZONES_PER_LAYER - len(rows))
    return found


def _level_rms(derivatives: Float64Array, count: int) -> list[float]:
    """Return the RMS per level over a number of texels of the finest; other texels are 0."""
    share = count / derivatives[..., 0].size
    found = []
    planes: FloatArray = np.moveaxis(derivatives, 2, 0)
    while True:
        found.append(float(np.sqrt(np.mean(np.sum(planes**2, axis=0)) / share)))
        if min(planes.shape[1:]) == 1:
            return found
        planes = resample(planes, (planes.shape[1] // 2, planes.shape[2] // 2))


def _map_shape(model: WrinkleModel) -> tuple[int, int]:
    shapes = [layer.wrinkle.shape for layer in model.layers]
    return (min(max(h for h, _, _ in shapes), MAP_PX), min(max(w for _, w, _ in shapes), MAP_PX))


def _plane(wrinkle: Any, shape: tuple[int, int]) -> Float32Array:
    planes = resample(np.moveaxis(np.asarray(wrinkle, np.float32), 2, 0), shape)
    return np.ascontiguousarray(np.moveaxis(planes, 0, 2))


def _masks(layers: tuple[WrinkleLayer, ...]) -> Float32Array:
    """Return two RGBA textures per layer, of one size."""
    side = max(max(layer.masks.shape[1:]) for layer in layers)
    out = []
    for layer in layers:
        if len(layer.masks) > ZONES_PER_LAYER:
            raise SceneError(
                f"masks: got {len(layer.masks)} zones, expected at most {ZONES_PER_LAYER}"
            )
        planes = resample(np.asarray(layer.masks, np.float32), (side, side))
        pair = mask_textures(planes)
        if len(pair) == 1:
            pair = np.concatenate([pair, np.zeros_like(pair)])
        out.append(pair)
    return np.concatenate(out).astype(np.float32)


MAPS_PX: Final = 256
"""Maximum side of the maps of roughness and intensity, which vary by region."""
RELIEF_STEP_WORDS: Final = 20
"""Quantization step of the finest octave for reliefs of 2048 texels per side and more; <= 5 um."""


def build_surface_assets(source: SceneSource) -> Assets:
    """Build neutral relief, um, roughness (Beckmann m) and specular intensity by region."""
    subject = source.subject
    covered = subject.atlas.covered
    height = source.skin.height_um()[..., None]
    # Beckmann's m and GGX's alpha have the same peak 1 / (pi m^2) of the normal distribution
    roughness = downsample(fill_holes(subject.roughness, covered), MAPS_PX)
    # hair hides the skin's specular reflection, as in the subject's own renderings
    intensity = 1.0 - downsample(fill_holes(subject.hair, covered), MAPS_PX)
    maps = np.stack([roughness, intensity], axis=-1)
    why = "simulated; used by the analytic specular model"
    fine = RELIEF_STEP_WORDS if len(height) >= 2048 else 1
    return {
        "textures": {
            "relief_height": Texture(height.astype(np.float32), "u8", "mipmap", fine=fine),
            "surface_maps": Texture(maps.astype(np.float32), "u8"),
        },
        "left_out": (("pores and roughness of this face", why),) if source.captured else (),
    }
