"""Align an image of an expression to the neutral one, by landmarks, then per pixel.

Named landmarks define a thin-plate spline, as smooth as their standard errors allow. Dense optical
flow refines it where the skin has texture. Both use local contrast, from which illumination and
regional changes of blood are removed: a change of blood in a region is not motion, and the vessels
keep their positions in the skin.

Without landmarks, matched features replace them, and the result records it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.skin import SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.correspondence import landmark_field
from reconstruction.registration import (
    RegistrationError,
    dense_flow,
    feature_matches,
    is_inside_image,
    normalize_local_contrast,
)

Points = Mapping[str, tuple[float, float]]

LANDMARK_STDERR_PX = 1.0
"""Standard error of a manually placed landmark in one image along each axis."""
FEATURE_STDERR_PX = 0.5
MAX_ALIGNMENT_ERROR_PX = 4.0
"""Maximum estimated error of a valid pixel."""
MIN_LANDMARKS = 20
"""Fewer landmarks leave much of a face to the flow alone."""
MIN_ALIGNED_SIDE_PX = 32


class AlignmentError(RegistrationError):
    """Images or landmarks that cannot be aligned."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Position of each pixel of the neutral image in the moving one.

    Attributes
    ----------
    source_px : ndarray of float32, shape (H, W, 2)
        Column and row in the moving image; undefined where not `valid`.
    valid : ndarray of bool, shape (H, W)
        Inside both images and their masks, not folded, and the error is small enough.
    error_px : ndarray of float32, shape (H, W)
        Estimated root mean square distance between `source_px` and the true position.
    residual_px : ndarray of float32, shape (H, W)
        Distance of a pixel from its start after the flow to the moving image and back.
    followed : ndarray of bool, shape (H, W)
        The optical flow was used; elsewhere the position is from landmarks and neighbors.
    landmark_rms_px : float
        Root mean square distance of the landmarks from their aligned positions.
    leave_one_out_px : mapping of str to float
        Distance of each landmark from its prediction by the others: a large one is misplaced, or
        the only landmark in a region of different motion.
    folded_fraction : float
        Fraction of the pixels within the masks where the map folds over.
    by : str
        "landmarks" or "features".
    moving_shape : (int, int)
        Rows and columns of the moving image.
    """

    source_px: Float32Array
    valid: BoolArray
    error_px: Float32Array
    residual_px: Float32Array
    followed: BoolArray
    landmark_rms_px: float
    leave_one_out_px: Mapping[str, float]
    folded_fraction: float
    by: Literal["landmarks", "features"]
    moving_shape: tuple[int, int]

    def __post_init__(self) -> None:
        """Refuse mismatched shapes."""
        shape = self.valid.shape
        Checks(AlignmentError).shape("source_px", self.source_px, (*shape, 2))
        Checks(AlignmentError).shape("error_px", self.error_px, shape)

    def warp(
        self, values: ArrayLike, valid: ArrayLike | None = None
    ) -> tuple[Float32Array, BoolArray]:
        """Warp a map of the moving image to the neutral one.

        Parameters
        ----------
        values : array_like, shape (h, w) or (h, w, C)
            Of the moving image's size.
        valid : array_like of bool, shape (h, w), optional
            Where `values` are valid.

        Returns
        -------
        values : ndarray of float32, shape (H, W) or (H, W, C)
            0 where not valid.
        valid : ndarray of bool, shape (H, W)
            Where all pixels of the interpolation are valid. It is bicubic, which preserves small
            contrast, and bilinear next to masked pixels.
        """
        image, good = self._checked(values, valid)
        filled = np.where(_match_channels(good, image), image, 0.0).astype(np.float32)
        unknown = (~good).astype(np.float32)
        near = dense_flow.sample_image(unknown, self.source_px)
        wide = dense_flow.sample_image(
            cv2.dilate(unknown, np.ones((5, 5), np.uint8)), self.source_px
        )
        seen = self.valid & (near <= 0.0)
        shape = seen.shape + image.shape[2:]
        linear = dense_flow.sample_image(filled, self.source_px).reshape(shape)
        cubic = dense_flow.sample_image(filled, self.source_px, interpolation=cv2.INTER_CUBIC)
        best = np.where(_match_channels(wide <= 0.0, image), cubic.reshape(shape), linear)
        return np.where(_match_channels(seen, image), best, 0.0).astype(np.float32), seen

    def warp_stderr(
        self, values: ArrayLike, stderr: ArrayLike, valid: ArrayLike | None = None
    ) -> Float32Array:
        """Return the standard error of a warped map, from its own and that of the position.

        Parameters
        ----------
        values, stderr : array_like, shape (h, w) or (h, w, C)
            Map of the moving image and its standard error.
        valid : array_like of bool, shape (h, w), optional

        Returns
        -------
        ndarray of float32
            Shape of the warped map, 0 where it is not valid. The noise reduction by interpolation
            is neglected. The position error contributes the map's slope (smoothed over 2 px) times
            the error of the position.
        """
        image, good = self._checked(values, valid)
        own, _ = self._checked(stderr, valid)
        variance, seen = self.warp(np.square(own), good)
        slope = _slope_variance(image, good)
        steep, _ = self.warp(slope, None)
        place = _match_channels(np.square(self.error_px) / 2.0, image)
        # bicubic interpolation may undershoot below 0
        total = np.maximum(variance, 0.0) + np.maximum(steep, 0.0) * place
        return np.where(_match_channels(seen, image), np.sqrt(total), 0.0).astype(np.float32)

    def warp_map(self, skin_map: SkinMap) -> SkinMap:
        """Warp a map with its own standard error and mask to the neutral image.

        The position error is not included: `reconstruction.facial_color.registration_error`
        computes it with the correlation between channels. The noise reduction by interpolation is
        included.

        Parameters
        ----------
        skin_map
            Map of the moving image.
        """
        values, seen = self.warp(skin_map.values, skin_map.valid)
        stderr = None
        if skin_map.stderr is not None:
            variance, _ = self.warp(np.square(skin_map.stderr), skin_map.valid)
            left = _match_channels(dense_flow.interpolated_noise_variance(self.source_px), values)
            stderr = np.sqrt(np.maximum(variance, 0.0) * left).astype(np.float32)
        return SkinMap(values, skin_map.unit, stderr, seen, skin_map.description)

    def _checked(
        self, values: ArrayLike, valid: ArrayLike | None
    ) -> tuple[Float32Array, BoolArray]:
        image = np.asarray(values, np.float32)
        check = Checks(AlignmentError).shape
        check("values", image, self.moving_shape, (*self.moving_shape, "C"))
        good = np.ones(self.moving_shape, bool) if valid is None else np.asarray(valid, bool)
        check("valid", good, self.moving_shape)
        return image, good & _valid_in_all_channels(np.isfinite(image))


def align(
    moving: ArrayLike,
    neutral: ArrayLike,
    *,
    landmarks_moving: Points | None = None,
    landmarks_neutral: Points | None = None,
    valid_moving: ArrayLike | None = None,
    valid_neutral: ArrayLike | None = None,
    landmark_stderr_px: float = LANDMARK_STDERR_PX,
    max_error_px: float = MAX_ALIGNMENT_ERROR_PX,
    rounds: int = dense_flow.N_WARP_ROUNDS,
) -> Alignment:
    """Align the image of an expression to the neutral image, per pixel.

    Parameters
    ----------
    moving, neutral : array_like, shape (h, w) or (h, w, 3), and (H, W) or (H, W, 3)
        Linear images, best of subsurface-scattered light (crossed polarizers); of colors the mean
        of their logarithms is used. Or maps with the same visible structure.
    landmarks_moving, landmarks_neutral : mapping of str to (x, y), optional
        Column and row, px; those of the same name are used, at least 4. Without both, features are
        matched.
    valid_moving, valid_neutral : array_like of bool, optional
        Skin in each image.
    landmark_stderr_px : float
        Standard error of a landmark in one image along each axis, above 0. It determines the
        smoothness of the motion between landmarks.
    max_error_px : float
        Pixels with a larger estimated error are invalid.
    rounds : int
        Number of dense flow rounds; 0: landmarks or features alone.

    Returns
    -------
    Alignment

    Raises
    ------
    AlignmentError
        For mismatched images or landmarks, or too few of either to estimate a motion.

    Notes
    -----
    A wrinkle that opens, an eye that closes or a lip that turns out has no counterpart. Such pixels
    are detected by forward and backward flows that disagree, and by folds.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> skin = cv2.GaussianBlur(rng.random((80, 80)).astype(np.float32), (0, 0), 1.5)
    >>> marks = {str(k): (20.0 + 40 * (k % 2), 20.0 + 40 * (k // 2)) for k in range(4)}
    >>> moved = {name: (x + 3, y) for name, (x, y) in marks.items()}
    >>> found = align(
    ...     np.roll(skin, 3, axis=1), skin, landmarks_moving=moved, landmarks_neutral=marks
    ... )
    >>> (found.source_px[40, 40] - [40, 40]).round(1).tolist()
    [3.0, 0.0]
    """
    if (landmarks_moving is None) != (landmarks_neutral is None):
        missing = "landmarks_moving" if landmarks_moving is None else "landmarks_neutral"
        got = f"{missing}: got None, expected landmarks of both images or neither"
        raise AlignmentError(f"{got}; add or omit them")
    Checks(AlignmentError).within("rounds", rounds, "[0, inf)")
    second, mask_second = _structure("moving", moving, valid_moving)
    first, mask = _structure("neutral", neutral, valid_neutral)
    by: Literal["landmarks", "features"]
    try:
        if landmarks_moving is not None and landmarks_neutral is not None:
            names, points, moved = _common(landmarks_moving, landmarks_neutral)
            by, stderr = "landmarks", math.sqrt(2.0) * landmark_stderr_px
        else:
            points, moved = feature_matches.match_features(
                first, second, valid=mask, valid_second=mask_second
            )
            names = [f"feature {k + 1}" for k in range(len(points))]
            by, stderr = "features", math.sqrt(2.0) * FEATURE_STDERR_PX
        field = landmark_field.fit_landmark_field(points, moved, stderr_px=stderr)
    except (feature_matches.FeatureError, landmark_field.LandmarkFieldError) as few:
        raise AlignmentError(str(few)) from few
    displacement, uncertain = field.evaluate_grid(first.shape)
    flow = dense_flow.refine_flow(
        first,
        second,
        dense_flow.pixel_grid(first.shape) + displacement,
        uncertain,
        valid=mask,
        valid_second=mask_second,
        rounds=rounds,
    )
    seen = _is_inside(flow.source_px, mask_second) & mask
    folded = _folded(flow.source_px)
    error = math.sqrt(2.0) * flow.stderr_px
    return Alignment(
        source_px=flow.source_px,
        valid=seen & ~folded & (error <= max_error_px),
        error_px=error.astype(np.float32),
        residual_px=flow.gap_px,
        followed=flow.followed,
        landmark_rms_px=_landmark_rms(flow.source_px, points, moved),
        leave_one_out_px=dict(zip(names, field.leave_one_out_px.tolist(), strict=True)),
        folded_fraction=float((folded & seen).sum() / max(int(seen.sum()), 1)),
        by=by,
        moving_shape=(second.shape[0], second.shape[1]),
    )


def _structure(name: str, picture: ArrayLike, valid: ArrayLike | None) -> tuple[Any, BoolArray]:
    """Return the local contrast of an image and where it is valid."""
    image = np.asarray(picture, np.float64)
    if image.ndim not in (2, 3) or min(image.shape[:2]) < MIN_ALIGNED_SIDE_PX:
        raise AlignmentError(
            f"{name}: got shape {image.shape}, expected (H, W) or (H, W, 3), at least "
            f"{MIN_ALIGNED_SIDE_PX} x {MIN_ALIGNED_SIDE_PX} px; give a larger image"
        )
    good = np.ones(image.shape[:2], bool) if valid is None else np.asarray(valid, bool)
    Checks(AlignmentError).shape(f"valid_{name}", good, image.shape[:2])
    good = good & _valid_in_all_channels(np.isfinite(image) & (image > 0.0))
    if not good.any():
        got = "got no valid pixel with light, expected some"
        raise AlignmentError(f"{name}: {got}; check its mask")
    shown = np.where(_match_channels(good, image), image, 1.0)
    value = np.exp(np.log(shown).mean(axis=-1)) if image.ndim == 3 else shown
    # masked pixels are filled from neighboring skin, so that the mask's edge adds no contrast
    weight = good.astype(np.float64)
    share = cv2.GaussianBlur(weight, (0, 0), 8.0)
    around = cv2.GaussianBlur(value * weight, (0, 0), 8.0) / np.maximum(share, 1e-6)
    middle = float(np.median(value[good]))
    around = np.where(share > 1e-3, around, middle)
    return normalize_local_contrast(np.where(good, value, around)), good


def _match_channels(array: NDArray[Any], image: NDArray[Any]) -> NDArray[Any]:
    """Expand an array of pixels (H, W) to broadcast with an image (H, W) or (H, W, C)."""
    return array[..., None] if image.ndim == 3 else array


def _valid_in_all_channels(good: BoolArray) -> BoolArray:
    """Return where all channels of (H, W) or (H, W, C) are valid, (H, W)."""
    return np.asarray(good.all(axis=-1)) if good.ndim == 3 else good


def _common(moving: Points, neutral: Points) -> tuple[list[str], Float64Array, Float64Array]:
    names = sorted(set(moving) & set(neutral))
    if len(names) < landmark_field.MIN_FIELD_POINTS:
        raise AlignmentError(
            f"landmarks: got {len(names)} names in both images, expected at least "
            f"{landmark_field.MIN_FIELD_POINTS}, best {MIN_LANDMARKS} or more; mark more"
        )
    return (
        names,
        np.array([neutral[name] for name in names], np.float64),
        np.array([moving[name] for name in names], np.float64),
    )


def _is_inside(source_px: Float32Array, mask: BoolArray) -> BoolArray:
    """Return which positions are inside an image, with all pixels around them in its mask."""
    missing = dense_flow.sample_image((~mask).astype(np.float32), source_px)
    return np.asarray(is_inside_image(source_px, mask.shape) & (missing <= 0.0))


def _folded(source_px: Float32Array) -> BoolArray:
    """Return where the map reverses its orientation, in any of a pixel's four triangles."""
    # the signed area dx x dy of a triangle's image is positive for a map without a fold
    padded = np.pad(
        source_px.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd"
    )
    middle = padded[1:-1, 1:-1]
    right, left = padded[1:-1, 2:] - middle, middle - padded[1:-1, :-2]
    below, above = padded[2:, 1:-1] - middle, middle - padded[:-2, 1:-1]
    least = np.full(source_px.shape[:2], np.inf)
    for along in (right, left):
        for across in (below, above):
            area = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
            least = np.minimum(least, area)
    return np.asarray(least <= 0.0)


def _landmark_rms(source_px: Float32Array, points: Float64Array, moved: Float64Array) -> float:
    inside = is_inside_image(points, source_px.shape)
    if not inside.any():
        return math.nan
    at = points[inside].astype(np.float32)[None]
    put = dense_flow.sample_image(source_px, at)[0]
    return float(np.sqrt(((put - moved[inside]) ** 2).sum(axis=1).mean()))


def _slope_variance(image: Float32Array, good: BoolArray) -> Float32Array:
    """Return the squared slope of a map per px, smoothed over 2 px."""
    weight = good.astype(np.float32)
    share = cv2.GaussianBlur(weight, (0, 0), 2.0)
    keep, spread = _match_channels(weight, image), _match_channels(share, image)
    known = np.where(keep > 0, image, 0.0).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(known, (0, 0), 2.0)).reshape(image.shape)
    smooth = smooth / np.maximum(spread, 1e-6)
    down, right = np.gradient(smooth, axis=(0, 1))
    return np.where(keep > 0, down**2 + right**2, 0.0).astype(np.float32)
