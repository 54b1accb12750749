"""Read masks of edits from images, and build them from regions of the face."""

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from model import store
from reconstruction.correspondence import common_regions
from reconstruction.correspondence.charts import TexelChart
from reconstruction.correspondence.common_parameterization import CommonFrame
from skinrig.arrays import Float32Array, Float64Array

FEATHER_MM = 6.0
"""Distance over which an edit of a region fades."""


class MaskError(ValueError):
    """An image that is not a valid mask of the texture."""


def read(path: Path, shape: tuple[int, int]) -> Float32Array:
    """Read a mask for a texture.

    Parameters
    ----------
    path
        PNG (gray level over its maximum code) or EXR (values 0 to 1) of the whole texture; row 0
        is the top. Another size is interpolated.
    shape
        Rows and columns of the texture.

    Returns
    -------
    ndarray of float32, shape (H, W)
        0 to 1.

    Raises
    ------
    MaskError
        If the file is not an image, has values outside 0 to 1 or another aspect ratio, or is 0
        everywhere.
    """
    kind = path.suffix.lower()
    if kind == ".exr":
        image = store.read_exr(path)
    elif kind == ".png":
        image = _png(path)
    else:
        raise MaskError(f"--mask: got {path.name}, expected a .png or .exr file; convert it")
    gray = np.asarray(image.mean(axis=-1) if image.ndim == 3 else image, np.float32)
    if not np.isfinite(gray).all() or gray.min() < 0 or gray.max() > 1:
        raise MaskError(f"--mask: {path} has values outside 0 to 1; rescale it")
    if gray.shape[0] * shape[1] != gray.shape[1] * shape[0]:
        raise MaskError(
            f"--mask: {path} has {gray.shape[1]} x {gray.shape[0]} pixels, expected the aspect "
            f"ratio of the texture, {shape[1]} x {shape[0]}; resize it"
        )
    if gray.shape != shape:
        rows = (np.arange(shape[0]) + 0.5) * gray.shape[0] / shape[0] - 0.5
        columns = (np.arange(shape[1]) + 0.5) * gray.shape[1] / shape[1] - 0.5
        at = np.meshgrid(rows, columns, indexing="ij")
        gray = map_coordinates(gray, at, order=1, mode="nearest").astype(np.float32)
    if not gray.any():
        raise MaskError(
            f"--mask: {path} is black everywhere, expected a region above 0; correct it"
        )
    return gray


def feather_region(name: str, frame: CommonFrame) -> Float64Array:
    """Return a region's weight in the common map, (N, N), 0 to 1, faded over `FEATHER_MM`."""
    inside = common_regions.region_mask(name, frame).astype(np.float64)
    if name == "face":
        return inside
    soft = gaussian_filter(inside, max(0.4 * FEATHER_MM / frame.pixel_mm, 0.5))
    share = np.clip(1.5 * soft - 0.25, 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def region_weights(name: str, frame: CommonFrame, chart: TexelChart) -> Float32Array:
    """Return a region's weight at the texels of a face, (H, W); 0 off the face."""
    if name == "face":
        return np.ones(chart.on_surface.shape, np.float32)
    share, inside = chart.read(feather_region(name, frame))
    return np.where(inside, np.clip(share, 0.0, 1.0), 0.0).astype(np.float32)


def _png(path: Path) -> Float32Array:
    import cv2

    try:
        raw = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise MaskError(f"--mask: {path}: {error.strerror}") from error
    image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if len(raw) else None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise MaskError(f"--mask: {path} is not readable as PNG; check the file")
    if image.ndim == 3 and image.shape[2] in (2, 4):
        image = image[..., :-1]
    return (image / np.iinfo(image.dtype).max).astype(np.float32)
