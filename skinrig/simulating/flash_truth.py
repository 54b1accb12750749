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
"""Maximum offset of a face from the white reference's position, as a fraction of the camera's
distance. It is far beyond the depth of field at f/11."""


def _stance_offset_mm(rig: Rig, nearer_mm: float) -> tuple[float, float, float]:
    """Return the translation, mm, of a face that is nearer to the camera than the reference.

    Raises
    ------
    SimulationError
        For an offset of more than `MAX_STANCE_FRACTION` of the camera's distance.
    """
    view = rig.views[0]
    limit = MAX_STANCE_FRACTION * view.distance_mm
    if not abs(nearer_mm) < limit:
        raise SimulationError(
            f"nearer: got {nearer_mm:g} mm, expected {-limit:g} to {limit:g} mm, because the "
            f"camera is {view.distance_mm:g} mm from the white reference"
        )
    x, y, z = (nearer_mm * axis for axis in view.axes[2])
    return x, y, z


def _nearer_mm(scene: Any) -> float:
    """Return how much nearer, mm, a scene's face is to its first camera than the reference.

    A patch of voxel skin is in the reference's position.
    """
    offset_mm = getattr(scene.subject, "offset_mm", (0.0, 0.0, 0.0))
    return float(np.dot(offset_mm, scene.rig.views[0].axes[2]))


def to_superpixels(values: NDArray[Any], mask: BoolArray | None = None) -> NDArray[Any]:
    """Average blocks of 2 x 2 pixels, over the pixels inside ``mask`` only.

    Parameters
    ----------
    values
        (H, W) or (H, W, C) with even H and W.
    mask
        (H, W); a block without a pixel inside is 0.

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
"""Names of the scene's maps in the ground truth. Light has its own unit in the simulator, but is
relative to a white reference in an estimate, so it does not keep the name."""


def scale_landmarks(pixels: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Transform points from sensor pixels to superpixels of 2 x 2 pixels.

    Parameters
    ----------
    pixels
        (x, y) on the sensor; the center of pixel (0, 0) is (0, 0).

    Returns
    -------
    dict
        [x, y] on the averaged map. The center of its first pixel is at (0.5, 0.5) on the sensor, so
        x' = (x - 0.5) / 2.

    Examples
    --------
    >>> scale_landmarks({"chin": (0.5, 2.5)})
    {'chin': [0.0, 1.0]}
    """
    return {name: [0.5 * (x - 0.5), 0.5 * (y - 0.5)] for name, (x, y) in pixels.items()}


def build_truth(
    scene: Any,
    seed: int,
    session: str,
    state: str,
    *,
    parameters: Mapping[str, Any] | None = None,
    with_oxygenation: bool = False,
) -> SkinAppearance:
    """Return the ground truth of a face's scene at superpixels, with further `parameters`."""
    maps: Mapping[str, NDArray[Any]] = scene.truth()
    mask = np.asarray(maps["mask"], bool)
    # a superpixel on the outline mixes skin and background, and hair covers skin: both are masked
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
    if with_oxygenation:
        oxygenation = np.full(whole.shape, scene.subject.tissue.oxygenation, np.float32)
        kept["oxygenation"] = SkinMap(oxygenation, MAP_UNITS["oxygenation"], valid=whole)
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
