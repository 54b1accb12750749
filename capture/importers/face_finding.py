"""Find the face in a photograph."""

import numpy as np

from capture.arrays import Float32Array

SEARCH_SIDE_PX = 480
"""Longest side of the image that is searched, pixels: the time does not grow with photographs."""
LEAST_FACE = 0.08
"""Least width of a face relative to the shorter side of the photograph."""
LEAST_WINDOW_PX = 24
"""Side of the cascade's own window, pixels."""
AGREEING_WINDOWS = 5
"""Least number of overlapping windows that find a face."""
WINDOW_TOLERANCE = 0.3
"""Difference of sides, relative to them, up to which two windows overlap."""
LEAST_RED_OVER_BLUE = 1.1
"""Least ratio of red and blue of skin in balanced light: 1.36 in linear sRGB of 15,256 measured
colors, 1.19 in the RGB of a camera without a color matrix."""
CROP_MARGINS = 0.35, 0.45
"""Width and height that a crop adds on each side of a face, relative to its width: the detector's
square ends at brows, mouth and cheeks."""


def find_face(rgb: Float32Array) -> tuple[int, int, int, int] | None:
    """Find the clearest upright face that is seen from the front.

    Local binary patterns in a cascade (Zhang et al. 2007), with the cascade that scikit-image
    ships. They compare neighboring pixels, so that neither exposure nor skin tone matters. The face
    is where most windows agree, of those that are redder than gray.

    Parameters
    ----------
    rgb
        (H, W, 3): linear light, white balanced, any scale; (H, W, 1) of a gray photograph.

    Returns
    -------
    tuple or None
        Left, top, width and height of the face's square, pixels; None: no face was found.

    Examples
    --------
    >>> find_face(np.full((64, 64, 1), 0.5, np.float32)) is None
    True
    """
    import cv2
    from skimage.data import lbp_frontal_face_cascade_filename
    from skimage.feature import Cascade

    scale = min(1.0, SEARCH_SIDE_PX / max(rgb.shape[:2]))
    size = [max(round(scale * side), 1) for side in rgb.shape[1::-1]]
    least = max(LEAST_WINDOW_PX, round(LEAST_FACE * min(size)))
    if least >= min(size):
        return None
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], -1)
    light = small.mean(axis=-1)
    white = max(float(np.percentile(light, 99)), np.finfo(np.float32).tiny)
    # with these two settings the cascade returns each window by itself
    windows = Cascade(lbp_frontal_face_cascade_filename()).detect_multi_scale(
        np.rint(255 * np.sqrt(np.clip(light / white, 0.0, 1.0))).astype(np.uint8),
        scale_factor=1.1,
        step_ratio=1,
        min_size=(least, least),
        max_size=(min(size), min(size)),
        min_neighbor_number=0,
        intersection_score_threshold=1.01,
    )
    squares = [[one[name] for name in ("c", "r", "width", "height")] for one in windows]
    places, counts = cv2.groupRectangles(squares, AGREEING_WINDOWS - 1, WINDOW_TOLERANCE)
    for k in np.argsort(-np.ravel(counts), kind="stable"):
        left, top, width, height = map(int, places[k])
        middle = small[top + height // 4 : top + height, left + width // 4 : left + 3 * width // 4]
        color = np.median(middle, axis=(0, 1))
        if color[0] >= LEAST_RED_OVER_BLUE * color[-1] or len(color) == 1:
            left, top, width, height = (round(side / scale) for side in (left, top, width, height))
            return left, top, width, height
    return None


def frame_face(
    face_px: tuple[int, int, int, int], size_px: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return the crop around a face: its square with `CROP_MARGINS`, inside the photograph.

    Parameters
    ----------
    face_px
        Left, top, width and height, pixels.
    size_px
        Width and height of the photograph, pixels.

    Examples
    --------
    >>> frame_face((175, 65, 100, 100), (512, 512)), frame_face((5, 5, 40, 40), (60, 60))
    ((140, 20, 170, 190), (0, 0, 59, 60))
    """
    left, top, width, height = face_px
    across, down = (round(share * width) for share in CROP_MARGINS)
    low = max(left - across, 0), max(top - down, 0)
    high = min(left + width + across, size_px[0]), min(top + height + down, size_px[1])
    return low[0], low[1], high[0] - low[0], high[1] - low[1]
