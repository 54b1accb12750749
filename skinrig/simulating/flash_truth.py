"""Ground truth of simulated flash images."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.arrays import BoolArray
from skinrig.simulating.orders import SimulationError

WIDTHS_PX = {"small": 768, "full": 3024}
MAX_STANCE_FRACTION = 0.5
"""Of the camera's distance: how far off the tile's place a face may stand, either way. Far beyond
what a lens of f/11 shows with any sharpness."""


def _stance_offset_mm(rig: Rig, nearer_mm: float) -> tuple[float, float, float]:
    """Return how far a face is off the tile's place that stands so much nearer to the camera."""
    view = rig.views[0]
    most = MAX_STANCE_FRACTION * view.distance_mm
    if not abs(nearer_mm) < most:
        raise SimulationError(
            f"nearer: got {nearer_mm:g} mm, expected between {-most:g} and {most:g} mm: the camera "
            f"is {view.distance_mm:g} mm from the tile's place"
        )
    x, y, z = (nearer_mm * axis for axis in view.axes[2])
    return x, y, z


def _nearer_mm(scene: Any) -> float:
    """Return how much nearer to its first camera than the tile's place a scene's face stands."""
    return float(np.dot(scene.subject.offset_mm, scene.rig.views[0].axes[2]))


def to_superpixels(values: NDArray[Any], mask: BoolArray | None = None) -> NDArray[Any]:
    """Average 2 x 2 pixels, over those inside ``mask`` only.

    Parameters
    ----------
    values
        (H, W) or (H, W, C) with even H and W.
    mask
        (H, W); a block without any pixel inside is 0.

    Examples
    --------
    >>> to_superpixels(np.arange(4.0).reshape(2, 2)).tolist()
    [[1.5]]
    """
    height, width = values.shape[0] // 2, values.shape[1] // 2

    def blocks(image: NDArray[Any]) -> NDArray[Any]:
        shape = (height, 2, width, 2, *image.shape[2:])
        return np.asarray(image[: 2 * height, : 2 * width].reshape(shape))

    if mask is None:
        return np.asarray(blocks(values).mean(axis=(1, 3)))
    weight = mask.astype(np.float64)
    if values.ndim == 3:
        weight = weight[..., None]
    total = blocks(np.where(weight > 0, values, 0.0)).sum(axis=(1, 3))
    count = blocks(weight).sum(axis=(1, 3))
    return np.asarray(total / np.maximum(count, 1.0))


_TRUTH_NAMES = {"diffuse": "diffuse_radiance", "specular": "specular_radiance", "shading": "light"}
"""The simulator's light is in its own unit; an estimate's is relative to a white tile."""


def scale_landmarks(pixels: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Return where points are after 2 x 2 pixels have been averaged.

    Parameters
    ----------
    pixels
        (x, y) on the sensor; the centre of pixel (0, 0) is (0, 0).

    Returns
    -------
    dict
        [x, y] on the averaged map, whose first pixel's centre lies amid four of the sensor's.

    Examples
    --------
    >>> scale_landmarks({"chin": (0.5, 2.5)})
    {'chin': [0.0, 1.0]}
    """
    return {name: [0.5 * (x - 0.5), 0.5 * (y - 0.5)] for name, (x, y) in pixels.items()}


def build_truth(
    scene: Any, seed: int, session: str, state: str, *, parameters: Mapping[str, Any] | None = None
) -> SkinAppearance:
    """Return the truth of a scene of a face, at superpixels; `parameters` joins its parameters."""
    maps: Mapping[str, NDArray[Any]] = scene.truth()
    mask = np.asarray(maps["mask"], bool)
    # a superpixel on the outline mixes skin and background: no truth is claimed for it
    # and where hair covers the skin there is none
    bare = mask & (np.asarray(maps["melanin"]) > 0)
    whole = to_superpixels(bare.astype(float)) == 1.0
    at_rest = np.asarray(maps.get("mask_at_rest", mask), bool)
    whole_at_rest = to_superpixels(at_rest.astype(float)) == 1.0
    kept = {}
    for name, values in maps.items():
        if name.startswith("mask") or (np.ndim(values) == 3 and np.shape(values)[2] != 3):
            continue
        unmoved = name.endswith("_at_rest")
        inside, valid = (at_rest, whole_at_rest) if unmoved else (mask, whole)
        small = to_superpixels(np.asarray(values, np.float64), inside).astype(np.float32)
        known = name.removesuffix("_at_rest").removesuffix("_blurred")
        unit = "mm" if name.endswith("_mm") else MAP_UNITS.get(known, "1")
        kept[_TRUTH_NAMES.get(name, name)] = SkinMap(small, unit, valid=valid)
    kept["mask"] = SkinMap(whole.astype(np.float32), "1")
    return SkinAppearance(
        kept,
        "simulated",
        parameters={
            "kind": "truth",
            "state": state,
            "movement": scene.movement,
            "nearer_mm": _nearer_mm(scene),
            "landmarks_px": scale_landmarks(scene.landmarks_px()),
            **(parameters or {}),
        },
        inputs={"session": session},
        left_out=tuple(scene.omitted),
        seed=seed,
    )
