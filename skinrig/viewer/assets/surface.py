"""What the page needs to wrinkle: base derivatives, wrinkle maps, zones, and who moves them.

Maps are those of `model.wrinkles.evaluation`: fitted (`skinrig fit wrinkles`) where a folder has
them, otherwise fitted to the simulated person's own expressions. The page adds them as
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
"""Side of wrinkle maps, at most: half a millimeter of a face; the paper has 256."""
MASK_PX: Final = 64
WEIGHTS_PX: Final = 128
"""Side of the normals that the zones' weights are found on."""
ZONES_PER_LAYER: Final = 8
"""Of each wrinkle map, in two RGBA textures."""
MAX_LAYERS: Final = 4
"""Wrinkle maps that the shader has room for."""


def build_assets(source: SceneSource) -> Assets:
    """Return the wrinkles of a scene, fitted ones before those of the simulated person."""
    dynamic = source.appearances.get("dynamic")
    if dynamic is not None and WRINKLE_FILE in dynamic.files:
        found = WrinkleModel.from_maps(dynamic.maps, bytes(dynamic.files[WRINKLE_FILE]))
        return build_model_assets(found, source, origin="fitted")
    found = fit_simulated_wrinkles(source.subject, size=min(source.size, MAP_PX))
    return build_model_assets(
        found, source, origin="simulated: fitted to the person's own expressions"
    )


def fit_simulated_wrinkles(subject: SimulatedSubject, *, size: int) -> WrinkleModel:
    """Return wrinkles fitted to the expressions of a simulated person.

    Parameters
    ----------
    subject : Subject
        At rest or posed; its mesh, seed and preset count.
    size : int
        Texels a side of the normals that are fitted and of the wrinkle map.
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
    # weights hardly depend on detail: found on coarse normals, then one map is fitted to them
    coarse = (min(WEIGHTS_PX, size),) * 2
    small = {name: _downsample_normals(normals, coarse) for name, normals in posed.items()}
    rough = fit_wrinkle_map(_downsample_normals(neutral, coarse), small, zones.masks, size=coarse)
    table = as_table(rough.model().layers[0].table)
    return fit_wrinkle_map(neutral, posed, zones.masks, size=(size, size), table=table).model()


def _downsample_normals(normals: Float32Array, shape: tuple[int, int]) -> Float32Array:
    planes = np.moveaxis(encode(normals, limit=None), 2, 0)
    return np.asarray(decode(np.moveaxis(resample(planes, shape), 0, 2)), np.float32)


def build_model_assets(model: WrinkleModel, source: SceneSource, *, origin: str) -> Assets:
    """Return textures and facts of a wrinkle model on a scene's mesh.

    A simulated face at rest keeps the relief that the surface's own assets bring: its base is left
    to them. A fitted base replaces them.

    Raises
    ------
    SceneError
        For more maps than the shader has room for.
    """
    if len(model.layers) > MAX_LAYERS:
        raise SceneError(
            f"layers: got {len(model.layers)} wrinkle maps, expected at most {MAX_LAYERS}"
        )
    tables = [as_table(layer.table) for layer in model.layers]
    driven = sorted({name for table in tables for name in table.rows} & set(source.mesh.shapes))
    if not driven:
        rows = ", ".join(tables[0].rows) if tables else "none"
        why = f"none of their expressions ({rows}) is a blend shape of the mesh"
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
    """Return the rms of slopes that pixels of 2^level texels still show, by zone and level.

    Of each zone's part of its wrinkle map at a weight of 1, over the texels where the map has
    anything: what a view loses by leaving wrinkles out is at most the zones' strengths times these
    times the largest change of the reflection by a slope.

    Parameters
    ----------
    model : WrinkleModel
    shape : (int, int)
        Of the page's maps: level 0.

    Returns
    -------
    list of list of float
        Eight zones a layer, layer by layer; levels down to one texel.
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
    """Return the rms at each level over so many texels of the finest; others are 0."""
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
    """Return two RGBA textures a layer, of one size."""
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
"""Most texels a side of roughness and intensity, which vary by region."""
RELIEF_STEP_WORDS: Final = 20
"""Words of the finest octave's steps, of reliefs of 2048 texels a side and more: 5 um at most."""


def build_surface_assets(source: SceneSource) -> Assets:
    """Return the relief at rest, um, and roughness (Beckmann m) and intensity by region."""
    subject = source.subject
    covered = subject.atlas.covered
    height = source.skin.height_um()[..., None]
    # Beckmann's m and GGX's alpha give a peak of the same height, 1 / (pi m^2)
    roughness = downsample(fill_holes(subject.roughness, covered), MAPS_PX)
    # hair hides the skin's gloss, as the subject's own renderings have it
    intensity = 1.0 - downsample(fill_holes(subject.hair, covered), MAPS_PX)
    maps = np.stack([roughness, intensity], axis=-1)
    why = "simulated; used by the analytic specular model"
    captured = source.kind in ("dynamic", "dome", "model")
    fine = RELIEF_STEP_WORDS if len(height) >= 2048 else 1
    return {
        "textures": {
            "relief_height": Texture(height.astype(np.float32), "u8", "mipmap", fine=fine),
            "surface_maps": Texture(maps.astype(np.float32), "u8"),
        },
        "left_out": (("pores and roughness of this face", why),) if captured else (),
    }
