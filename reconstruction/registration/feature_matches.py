"""Match points of two images without landmarks.

Scale-invariant features are matched by their descriptors both ways. The texture of skin repeats, so
that many matches are wrong: those that agree with a rough common motion are kept, and of these the
ones that move like their neighbors.

References
----------
Lowe 2004, Distinctive image features from scale-invariant keypoints,
doi:10.1023/B:VISI.0000029664.99615.94
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array, UInt8Array
from reconstruction.registration.tracking import RegistrationError

MAX_FEATURES = 3000
MAX_LOWE_RATIO = 0.85
"""Ratio of best to second best distance above which a match is ambiguous (Lowe's ratio)."""
MAX_AFFINE_DEVIATION = 0.06
"""Largest deviation from the common affine motion, as a fraction of the image's diagonal."""
N_NEIGHBORS = 8
MAX_NEIGHBOR_DEVIATION = 0.25
"""Largest deviation from the neighbors' motion, as a fraction of their distance."""
MIN_NEIGHBOR_DEVIATION_PX = 1.5
"""Deviation from the neighbors' motion that is allowed at any distance, px."""
CELLS_PER_SIDE = 24
"""Cells per side of the image; at most one match is kept per cell."""
MIN_MATCHES = 12
"""Fewest agreeing matches; fewer may agree by chance."""


class FeatureError(RegistrationError):
    """Two images with too few common points."""


def match_features(
    first: UInt8Array, second: UInt8Array, *, valid: BoolArray, valid_second: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """Match points that two images have in common.

    Parameters
    ----------
    first, second : ndarray of uint8, (H, W)
        Local contrast, see `reconstruction.registration.normalize_local_contrast`.
    valid, valid_second : ndarray of bool
        Pixels in which features may be.

    Returns
    -------
    points_px, moved_px : ndarray of float64, shape (K, 2)
        Column and row in the first and in the second image, K at least `MIN_MATCHES`.

    Raises
    ------
    FeatureError
        When too few features agree on a motion.
    """
    finder = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=0.02)
    places, words = [], []
    for image, mask in ((first, valid), (second, valid_second)):
        keys, descriptors = finder.detectAndCompute(image, mask.astype(np.uint8) * 255)
        places.append(np.array([key.pt for key in keys], np.float64).reshape(-1, 2))
        words.append(descriptors)
    if min(len(place) for place in places) < MIN_MATCHES:
        raise FeatureError(
            f"features: found {len(places[0])} and {len(places[1])}, "
            f"expected at least {MIN_MATCHES} in both images; give landmarks"
        )
    pairs = _mutual(words[0], words[1])
    one, two = places[0][pairs[:, 0]], places[1][pairs[:, 1]]
    one, two = _smooth(one, two, float(np.hypot(*first.shape)))
    if len(one) < MIN_MATCHES:
        raise FeatureError(
            f"features: got {len(one)} that agree on a smooth motion, expected at least "
            f"{MIN_MATCHES}; "
            "give landmarks"
        )
    return one, two


def _mutual(words: Any, others: Any) -> NDArray[np.intp]:
    """Return pairs of descriptors that are mutually nearest and clearly nearer than the second."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    there = matcher.knnMatch(words, others, k=2)
    back = [m[0].trainIdx for m in matcher.knnMatch(others, words, k=1)]
    pairs = [
        (m[0].queryIdx, m[0].trainIdx)
        for m in there
        if len(m) == 2
        and m[0].distance < MAX_LOWE_RATIO * m[1].distance
        and back[m[0].trainIdx] == m[0].queryIdx
    ]
    return np.array(pairs, np.intp).reshape(-1, 2)


def _smooth(
    one: Float64Array, two: Float64Array, diagonal: float
) -> tuple[Float64Array, Float64Array]:
    """Keep matches that follow the common motion and that of their neighbors."""
    if len(one) < MIN_MATCHES:
        return one[:0], two[:0]
    cv2.setRNGSeed(0)  # sampling is repeatable
    _, inlier = cv2.estimateAffine2D(
        one,
        two,
        method=cv2.RANSAC,
        ransacReprojThreshold=MAX_AFFINE_DEVIATION * diagonal,
        maxIters=5000,
    )
    kept = np.flatnonzero(np.asarray(inlier).reshape(-1) == 1)
    one, two = one[kept], two[kept]
    for _ in range(3):
        if len(one) <= N_NEIGHBORS:
            return one[:0], two[:0]
        apart = np.linalg.norm(one[:, None] - one, axis=-1)
        near = np.argsort(apart, axis=1, kind="stable")[:, 1 : N_NEIGHBORS + 1]
        motion = two - one
        middle = np.median(motion[near], axis=1)
        far = np.median(np.take_along_axis(apart, near, axis=1), axis=1)
        off = np.linalg.norm(motion - middle, axis=1)
        good = off <= MAX_NEIGHBOR_DEVIATION * far + MIN_NEIGHBOR_DEVIATION_PX
        one, two = one[good], two[good]
        if good.all():
            break
    cell = np.floor(one / (diagonal / np.sqrt(2.0) / CELLS_PER_SIDE)).astype(int)
    _, first = np.unique(cell, axis=0, return_index=True)
    return one[np.sort(first)], two[np.sort(first)]
