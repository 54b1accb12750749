"""Write base color and color deltas of expressions, from the hemoglobin rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from model import fresnel, store
from model.skin import SkinAppearance
from model.texture_resampling import resample
from reconstruction.correspondence import landmark_field, landmark_table
from reconstruction.surface.texture_fill import push_pull
from skinrig.applying import expression
from skinrig.arrays import BoolArray, Float64Array
from skinrig.exporting.images import CAMERA_SPACE, DATA_SPACE, SRGB_SPACE, ExportImage, ImageFolder
from skinrig.exporting.options import ExportError, ExportSettings

COLOR_SIZE, MAX_STATES = 512, 3
NEUTRAL: Final = "neutral"
LANDMARK_STDERR_PX: Final = 1.0
MIN_KNOWN_FRACTION: Final = 0.5
"""Minimum valid fraction of a pixel's area."""


@dataclass(frozen=True, slots=True, eq=False)
class Colors:
    """Base color and deltas on one layout.

    Attributes
    ----------
    base
        (N, N, 3), linear.
    deltas
        Color minus the neutral color by expression, (N, N, 3).
    valid
        (N, N) valid pixels.
    layout
        Layout of the pixels, in words.
    space
        Color space of `base`, see :mod:`skinrig.exporting.images`.
    """

    base: Float64Array
    deltas: Mapping[str, Float64Array]
    valid: BoolArray
    layout: str
    space: str


def write(appearance: SkinAppearance, out: ImageFolder) -> tuple[dict[str, Any], list[str]]:
    """Write base color and color deltas.

    Parameters
    ----------
    appearance
        Appearance with the part facial_color.
    out
        Destination folder.

    Returns
    -------
    document : dict
        JSON values: layout, expressions by map, largest deltas.
    states : list of str
        All expressions of the rig.
    """
    rig = expression.read_hemoglobin_rig(appearance)
    have = sorted(rig.states)
    states = select_states(have, "color", out)
    colors = _colors(appearance, rig, states, out)
    names = {f"cm{k}": state for k, state in enumerate(states, start=1)}
    what = f"neutral base color on {colors.layout}; {colors.space}; holes filled"
    filled = push_pull(colors.base, colors.valid.astype(np.float32)).values.astype(np.float64)
    out.write_exr_and_png(
        ExportImage("base_color", filled, space=SRGB_SPACE, what=what, valid=colors.valid)
    )
    largest = {}
    for name, state in names.items():
        delta = colors.deltas[state]
        what = f"color of {state} at weight 1 minus neutral, linear, on {colors.layout}"
        out.write_exr_and_png(
            ExportImage(f"{name}_delta", delta, "1", DATA_SPACE, what, -1.0, 1.0, colors.valid)
        )
        shown = np.abs(delta[colors.valid])
        largest[name] = float(shown.max()) if shown.size else 0.0
    out.errors([ExportImage("color_mask", colors.valid.astype(float))])
    document = {
        "layout": colors.layout,
        "space": colors.space,
        "maps": names,
        "largest_delta": largest,
    }
    return {"size": COLOR_SIZE, **document, "valid_share": float(colors.valid.mean())}, have


def _colors(appearance: SkinAppearance, rig: Any, states: list[str], out: ImageFolder) -> Colors:
    melanin = appearance.maps["melanin"]
    seen = melanin.mask.copy()
    blends = {}
    for state in (NEUTRAL, *states):
        blends[state] = rig.evaluate({state: 1.0})
        seen &= blends[state].valid
    shown = {
        state: expression.skin_reflectance(melanin.values, blend.hemoglobin, seen).astype(
            np.float64
        )
        for state, blend in blends.items()
    }
    neutral = shown[NEUTRAL]
    if out.delivery.target_face is None:
        why = (
            "they are on the flash camera's image; give the dome's "
            "maps with --target-face, and two tables of landmarks"
        )
        out.record_omission("colors on the face's texture", why)
        base, valid = resize_map(neutral, seen, COLOR_SIZE)
        deltas = {s: resize_map(shown[s] - neutral, seen, COLOR_SIZE)[0] for s in states}
        height, width = seen.shape
        layout = f"the flash camera's image, {width} x {height}, stretched to a square"
        return Colors(base, deltas, valid, layout, SRGB_SPACE)
    return _on_texture(out.delivery, shown, seen, states)


def _on_texture(
    delivery: ExportSettings,
    colors: Mapping[str, Float64Array],
    visible: BoolArray,
    states: list[str],
) -> Colors:
    """Map colors to another appearance's texture: its albedo with the changes of the rig."""
    if delivery.target_face is None or len(delivery.landmarks) != 2:
        raise ExportError(
            f"--landmarks: got {len(delivery.landmarks)} tables, expected two with --target-face: "
            "of the flash image, then of the texture; give both"
        )
    other = store.read(delivery.target_face)
    albedo = other.maps.get("r_d")
    if albedo is None:
        maps = ", ".join(sorted(other.maps)) or "none"
        raise ExportError(f"{delivery.target_face}: got maps {maps}, expected r_d; reconstruct it")
    inside = 1.0 - fresnel.diffuse_external(fresnel.ETA_SKIN)
    base, valid = resize_map(inside * albedo.values.astype(np.float64), albedo.mask, COLOR_SIZE)
    source = _source_pixels(delivery, albedo.values.shape[:2])
    neutral = colors[NEUTRAL]
    deltas: dict[str, Float64Array] = {}
    for state in states:
        # changes are transferred as ratios, which are independent of exposure and illumination
        ratio = np.divide(colors[state], neutral, out=np.ones_like(neutral), where=neutral > 1e-3)
        carried, known = _sample_map(ratio - 1.0, visible, source)
        deltas[state] = base * carried
        deltas[state][~known] = 0.0
        valid &= known
    layout = f"the texture of {delivery.target_face.name}, by landmarks"
    return Colors(base, deltas, valid, layout, CAMERA_SPACE)


def _source_pixels(delivery: ExportSettings, shape: tuple[int, int]) -> Float64Array:
    """Return the flash image's column and row for each pixel of the pack, (N, N, 2)."""
    own, onto = (landmark_table.read_landmark_table(path) for path in delivery.landmarks)
    names = sorted(set(own) & set(onto))
    try:
        field = landmark_field.fit_landmark_field(
            [onto[n] for n in names], [own[n] for n in names], stderr_px=LANDMARK_STDERR_PX
        )
    except landmark_field.LandmarkFieldError as error:
        raise ExportError(f"--landmarks: {error}") from error
    rows, columns = np.mgrid[0:COLOR_SIZE, 0:COLOR_SIZE] + 0.5
    pixel = [columns * shape[1] / COLOR_SIZE - 0.5, rows * shape[0] / COLOR_SIZE - 0.5]
    texel = np.stack(pixel, axis=-1)
    # the correspondence is smooth: every eighth pixel is mapped, others are interpolated
    step = texel[::8, ::8].reshape(-1, 2)
    moved = field.evaluate(step)[0].reshape(*texel[::8, ::8].shape)
    fine = np.moveaxis(_refined(np.moveaxis(moved, -1, 0)), 0, -1)
    return texel + fine


def _refined(coarse: Float64Array) -> Float64Array:
    """Upsample (C, n, n) eightfold, linearly; extrapolate beyond the last sample."""
    for axis in (1, 2):
        n = coarse.shape[axis]
        at = np.arange(COLOR_SIZE) / 8.0
        low = np.minimum(at.astype(int), n - 2)
        part = np.expand_dims(at - low, tuple(k for k in range(3) if k != axis))
        coarse = (1.0 - part) * np.take(coarse, low, axis) + part * np.take(coarse, low + 1, axis)
    return coarse


def _sample_map(
    values: Float64Array, visible: BoolArray, source: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Sample an image bilinearly among its valid pixels."""
    from scipy.ndimage import map_coordinates

    at = [source[..., 1], source[..., 0]]
    share = map_coordinates(visible.astype(np.float64), at, order=1, cval=0.0)
    layers = [
        map_coordinates(np.where(visible, values[..., c], 0.0), at, order=1, cval=0.0)
        for c in range(values.shape[-1])
    ]
    known = share >= MIN_KNOWN_FRACTION
    return np.stack(layers, axis=-1) / np.where(known, share, 1.0)[..., None], known


def select_states(available: list[str], quantity: str, out: ImageFolder) -> list[str]:
    """Select up to three expressions, the requested ones first."""
    only = out.delivery.only
    names = [name for name in only if name in available] if only else available
    for name in names[MAX_STATES:]:
        out.record_omission(
            f"{quantity} of {name}", f"a pack has at most {MAX_STATES}; choose with --only"
        )
    return names[:MAX_STATES]


def resize_map(values: Float64Array, valid: BoolArray, size: int) -> tuple[Float64Array, BoolArray]:
    """Resize a map by means over valid pixels; 0 without any."""
    layers = np.moveaxis(np.where(valid[..., None], values, 0.0), -1, 0)
    share = resample(valid.astype(np.float64), (size, size))
    found = np.moveaxis(resample(layers, (size, size)), 0, -1)
    good = share >= MIN_KNOWN_FRACTION
    return np.where(good[..., None], found / np.where(good, share, 1.0)[..., None], 0.0), good
