"""Fuse the normals of a magnified patch with those of the face that it is part of.

The face's normals, of millimeters per texel, give the low frequencies and the frame. The patch's,
of micrometers per pixel, give the high frequencies: its own tilt and form are those of skin in
front of another camera. A field of slopes has no curl. Normals that were turned about the camera's
axis have some, which states the angle without a second rig.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage
from scipy.stats import chi2

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.fusion.consistency import FAULT_PRIOR
from reconstruction.fusion.signals import FusionError
from reconstruction.normal_integration.height_filters import SIGMA_PER_CUTOFF

MIN_FRAME_TEXELS: Final = 6
"""Fewer texels do not determine a normal and its change along the surface."""
ALIGNMENT_SD_RAD: Final = float(np.radians(3.0))
"""Standard deviation of a patch's rotation about its normal and of errors that act like one.

Slopes whose gain differs by a tenth between two axes turn oblique furrows by up to 3 degrees."""
AIM_SD_RAD: Final = float(np.radians(5.0))
"""Standard deviation of the angle between camera axis and skin, per axis; assumed."""
FREE_ROTATION_SD_RAD: Final = float(np.radians(60.0))
"""Standard deviation of the rotation of a faulty patch."""
FREE_TILT_SD_RAD: Final = float(np.radians(20.0))
"""Standard deviation of the tilt of a faulty patch, per axis."""
SMOOTH_PX: Final = 3.0
"""Blur of slopes before they are differentiated, as pixels have noise of their own."""
BLOCKS_PER_SIDE: Final = 4
"""Blocks along each axis whose scatter gives the standard error of the rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchNormals:
    """Normals of a patch in its camera's frame: x right, y up, z to the camera.

    Attributes
    ----------
    normals
        (H, W, 3): unit vectors.
    stderr_rad
        (H, W): standard error of a normal in each of two perpendicular directions.
    valid
        (H, W) bool.
    pixel_um
        Size of a pixel on the skin.
    """

    normals: FloatArray
    stderr_rad: FloatArray
    valid: BoolArray
    pixel_um: float

    @property
    def slopes(self) -> Float64Array:
        """Slopes of the height along x and y, (H, W, 2); 0 where not valid."""
        n = np.where(self.valid[..., None], self.normals, [0.0, 0.0, 1.0]).astype(np.float64)
        return np.asarray(-n[..., :2] / np.maximum(n[..., 2:], 0.05))

    @property
    def offset_mm(self) -> Float64Array:
        """Distances of the pixels from the patch's center to the right and up, (H, W, 2), mm."""
        height, width = self.valid.shape
        right = np.arange(width) - (width - 1) / 2
        up = (height - 1) / 2 - np.arange(height)
        return np.stack(np.meshgrid(right, up), axis=-1) * (self.pixel_um / 1e3)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFrame:
    """Normal of a face around one place, with its covariance.

    Attributes
    ----------
    origin_mm
        (3,): the place.
    axes
        (3, 3): rows are unit vectors to the right, up, and the normal, in the face's frame.
    bend_per_mm
        (2, 2): change of the normal's components to the right and up, per mm along both.
    covariance
        (2, 2): of these components, rad^2, by the face's errors and the unknown place.
    """

    origin_mm: Float64Array
    axes: Float64Array
    bend_per_mm: Float64Array
    covariance: Float64Array

    @classmethod
    def fit(
        cls,
        origin_mm: Float64Array,
        position_mm: FloatArray,
        normals: FloatArray,
        stderr_rad: FloatArray,
        *,
        place_sd_mm: float,
    ) -> "SurfaceFrame":
        """Fit the normal and its change to texels around a place.

        Parameters
        ----------
        origin_mm
            (3,): the place.
        position_mm, normals
            (N, 3): points and unit normals of the texels around it.
        stderr_rad
            (N,): standard errors of the normals. Neighbors share their errors, so that the median
            counts, not that of a mean.
        place_sd_mm
            Standard deviation of the place, per axis.

        Raises
        ------
        FusionError
            If fewer than `MIN_FRAME_TEXELS` texels are given.

        Examples
        --------
        >>> at = np.random.default_rng(0).uniform(-3.0, 3.0, (40, 3)) * [1, 1, 0]
        >>> bowl = unit_vectors(np.column_stack([at[:, :2] / 80.0, np.ones(40)]))
        >>> frame = SurfaceFrame.fit(np.zeros(3), at, bowl, np.full(40, 0.02), place_sd_mm=4.0)
        >>> frame.bend_per_mm.round(4).tolist()
        [[0.0125, -0.0], [-0.0, 0.0125]]
        >>> np.sqrt(np.diag(frame.covariance)).round(3).tolist()
        [0.054, 0.054]
        """
        if len(position_mm) < MIN_FRAME_TEXELS:
            raise FusionError(
                f"position_mm: got {len(position_mm)} texels around the patch, expected "
                f"{MIN_FRAME_TEXELS} or more; give another place"
            )
        normal = unit_vectors(np.asarray(normals, np.float64).mean(axis=0))
        # up: the part of the face's y axis within the surface; x for a surface that faces up
        up = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.95 else np.array([0.0, 0.0, -1.0])
        right = unit_vectors(np.cross(up, normal))
        axes = np.stack([right, np.cross(normal, right), normal])
        off = (position_mm - origin_mm) @ axes.T
        local = np.asarray(normals, np.float64) @ axes.T
        local = local[:, :2] / np.maximum(local[:, 2:], 0.1)
        design = np.column_stack([np.ones(len(off)), off[:, :2]])
        found = np.linalg.lstsq(design, local, rcond=None)[0]
        rest = local - design @ found
        bend = found[1:].T
        # the fitted middle turns the frame
        normal = unit_vectors(np.array([found[0, 0], found[0, 1], 1.0]) @ axes)
        right = unit_vectors(np.cross(up, normal))
        axes = np.stack([right, np.cross(normal, right), normal])
        covariance = float(np.median(stderr_rad)) ** 2 * np.eye(2)
        covariance = covariance + place_sd_mm**2 * bend @ bend.T
        covariance += rest.T @ rest / max(len(rest) - 3, 1)
        return cls(np.asarray(origin_mm, np.float64), axes, bend, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class FusedPatch:
    """Normals of a patch in the face's frame.

    Attributes
    ----------
    normals
        (H, W, 3): unit vectors.
    position_mm
        (H, W, 3): points of the pixels on the face.
    covariance
        (H, W, 2, 2): of the components to the right and up, rad^2, by all errors.
    common
        (2, 2): the part that all pixels share.
    valid
        (H, W) bool.
    """

    normals: Float64Array
    position_mm: Float64Array
    covariance: Float64Array
    common: Float64Array
    valid: BoolArray


def fuse_patch(patch: PatchNormals, frame: SurfaceFrame, *, cutoff_um: float) -> FusedPatch:
    """Compose the face's low frequencies and the patch's high ones.

    Parameters
    ----------
    patch
        Normals of the patch.
    frame
        The face around it.
    cutoff_um
        Wavelength that both halve: twice the size of the face's texels.

    Examples
    --------
    A patch that its camera viewed 20 degrees askew has no tilt of its own after the fusion:

    >>> tilted = np.broadcast_to([0.342, 0.0, 0.94], (8, 8, 3))
    >>> patch = PatchNormals(tilted, np.full((8, 8), 0.02), np.ones((8, 8), bool), 6.0)
    >>> flat = SurfaceFrame(np.zeros(3), np.eye(3), np.zeros((2, 2)), 0.01**2 * np.eye(2))
    >>> found = fuse_patch(patch, flat, cutoff_um=4000.0)
    >>> float(np.abs(found.normals - [0, 0, 1]).max().round(6))
    0.0
    >>> round(float(found.covariance[0, 0, 0, 0]) ** 0.5, 4)
    0.0224
    """
    slopes = patch.slopes
    sigma = SIGMA_PER_CUTOFF * cutoff_um / patch.pixel_um
    weight = _blur(patch.valid.astype(np.float64), sigma)
    low = np.stack([_blur(slopes[..., k] * patch.valid, sigma) for k in range(2)], axis=-1)
    high = slopes - low / np.maximum(weight, 1e-9)[..., None]
    off = patch.offset_mm
    tangent = off @ frame.bend_per_mm.T - high
    local = unit_vectors(np.concatenate([tangent, np.ones((*high.shape[:2], 1))], axis=-1))
    normals = local @ frame.axes
    # an unknown rotation about the normal moves a slope at right angles to it
    turned = np.stack([-high[..., 1], high[..., 0]], axis=-1)
    covariance = np.square(patch.stderr_rad.astype(np.float64))[..., None, None] * np.eye(2)
    covariance = covariance + frame.covariance
    covariance += ALIGNMENT_SD_RAD**2 * turned[..., :, None] * turned[..., None, :]
    position = frame.origin_mm + off @ frame.axes[:2]
    return FusedPatch(normals, position, covariance, frame.covariance, patch.valid)


def _blur(values: Float64Array, sigma_px: float) -> Float64Array:
    """Filter by a Gaussian up to a common factor; it ends where the image does."""
    radius = min(int(4.0 * sigma_px + 0.5), max(values.shape))
    blurred = ndimage.gaussian_filter(values, sigma_px, mode="constant", radius=radius)
    return np.asarray(blurred, np.float64)


@dataclass(frozen=True, slots=True)
class PatchCheck:
    """Agreement of a patch's normals with a surface in front of its camera.

    Attributes
    ----------
    rig
        Name.
    probability
        Posterior probability that the normals are turned.
    rotation_rad, rotation_stderr_rad
        Rotation about the camera's axis that the curl of the slopes implies.
    tilt_rad
        Angle of the mean normal from the camera's axis.
    p_value
        Probability of such angles if the rig is as stated.
    """

    rig: str
    probability: float
    rotation_rad: float
    rotation_stderr_rad: float
    tilt_rad: float
    p_value: float

    def describe(self, quantity: str) -> str:
        """Return the contradiction in words.

        Parameters
        ----------
        quantity
            Name of the rig's quantity.

        Examples
        --------
        >>> PatchCheck("gradient", 0.99, 0.5, 0.02, 0.01, 1e-9).describe("normals")
        'gradient: normals turned by 29 degrees about the camera axis, tilted by 1 degrees from \
it, p = 1e-09, probability 0.99'
        """
        turned, tilted = np.degrees([abs(self.rotation_rad), self.tilt_rad])
        return (
            f"{self.rig}: {quantity} turned by {turned:.0f} degrees about the camera axis, tilted "
            f"by {tilted:.0f} degrees from it, p = {self.p_value:.0e}, probability "
            f"{self.probability:.2f}"
        )


def check_patch(patch: PatchNormals, *, rig: str = "gradient") -> PatchCheck:
    """Return whether the normals of a patch are those of a surface in front of its camera.

    Parameters
    ----------
    patch
        Normals of the patch.
    rig
        Name of the rig.

    Notes
    -----
    Slopes turned by an angle t have the curl sin t and the divergence cos t times the Laplacian of
    the height. A rotation by 180 degrees has no curl and is not found.
    """
    rotation, stderr = _measure_rotation(patch)
    mean = patch.normals[patch.valid].astype(np.float64).mean(axis=0)
    tilt = mean[:2] / max(float(np.linalg.norm(mean)), 1e-9)
    log_ratio, squares = 0.0, 0.0
    for value, sd, free in (
        (rotation, float(np.hypot(stderr, ALIGNMENT_SD_RAD)), FREE_ROTATION_SD_RAD),
        (float(tilt[0]), AIM_SD_RAD, FREE_TILT_SD_RAD),
        (float(tilt[1]), AIM_SD_RAD, FREE_TILT_SD_RAD),
    ):
        wide = sd**2 + free**2
        # either fault alone explains both angles: the better one of the two counts
        explained = value**2 / sd**2 - value**2 / wide
        log_ratio = max(log_ratio, 0.5 * float(explained + np.log(sd**2 / wide)))
        squares += value**2 / sd**2
    odds = FAULT_PRIOR / (1.0 - FAULT_PRIOR) * float(np.exp(min(log_ratio, 700.0)))
    p_value = float(chi2.sf(squares, 3))
    angle = float(np.arcsin(min(1.0, float(np.linalg.norm(tilt)))))
    return PatchCheck(rig, odds / (1.0 + odds), rotation, stderr, angle, p_value)


def _measure_rotation(patch: PatchNormals) -> tuple[float, float]:
    """Return the rotation of the slopes about the camera's axis and its standard error, rad."""
    weight = np.maximum(_blur(patch.valid.astype(np.float64), SMOOTH_PX), 1e-9)
    slopes = patch.slopes * patch.valid[..., None]
    p, q = (_blur(slopes[..., k], SMOOTH_PX) / weight for k in range(2))
    # rows run down, y up
    curl = np.gradient(q, axis=1) + np.gradient(p, axis=0)
    divergence = np.gradient(p, axis=1) - np.gradient(q, axis=0)
    margin = int(np.ceil(2.0 * SMOOTH_PX))
    inner = ndimage.binary_erosion(patch.valid, iterations=margin)
    sums = []
    for rows in np.array_split(np.arange(inner.shape[0]), BLOCKS_PER_SIDE):
        for columns in np.array_split(np.arange(inner.shape[1]), BLOCKS_PER_SIDE):
            at = np.ix_(rows, columns)
            c, d = curl[at][inner[at]], divergence[at][inner[at]]
            # curl and divergence are sin t and cos t times one field: the double angle is theirs
            sums.append((2.0 * float(c @ d), float(d @ d) - float(c @ c)))
    pairs = np.array(sums)
    total = pairs.sum(axis=0)
    if not total.any():
        return 0.0, FREE_ROTATION_SD_RAD
    angle = 0.5 * float(np.arctan2(*total))
    others = total - pairs
    # jackknife over the blocks, of the deviation from the angle of all
    turn = np.arctan2(others[:, 0], others[:, 1]) - 2.0 * angle
    off = 0.5 * np.arctan2(np.sin(turn), np.cos(turn))
    count = len(off)
    return angle, float(np.sqrt((count - 1) / count * ((off - off.mean()) ** 2).sum()))
