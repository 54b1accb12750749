"""Locate a mirror sphere in calibrated cameras by its outlines.

The rays that touch a sphere form a cone around the ray to its center. Its image is an ellipse whose
middle is not the center's image. Centers are therefore fitted to rays, never to a circle in the
image.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from capture.arrays import BoolArray, Float64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.record import CalibrationError
from capture.calibration.robust import HUBER_SIGMAS, mad_sigma

_log = logging.getLogger(__name__)

N_OUTLINE_ANGLES = 180  # points on the outline where an edge is searched
EDGE_SEARCH_RADII = 0.12  # distance from the outline, relative to its radius, in the first search
MIN_EDGE_SEARCH_PX = 3.0
EDGE_STEP_PX = 0.25
FINE_STEP_PX = 0.125
FINE_SEARCH_PX = 1.5
FINE_WINDOW_PX = 9.0
PIXEL_BLUR_PX = 0.5  # a pixel's square and the interpolation between pixels, as a Gaussian
MIN_OUTLINE_EDGES = 30
# root of the brightest over the usual background along a line across the edge
MAX_GLARE_RATIO = 1.15
VOTE_CELL_PX = 2.0  # cells of the search for the sphere
MAX_SPHERE_STEPS = 30
SPHERE_STEP_TOL_MM = 1e-7
MAX_RADIUS_SIGMAS = 5.0
MAX_RADIUS_MISFIT = 0.002  # relative difference of the radius that is accepted


class MirrorSphereError(CalibrationError):
    """Raised for images in which a mirror sphere cannot be located; the message names them."""


@dataclass(frozen=True, slots=True, eq=False)
class SpherePosition:
    """Position of a sphere.

    Attributes
    ----------
    center_mm : ndarray of float64, shape (3,)
        Rig frame.
    radius_mm : float
        As given.
    covariance_mm2 : ndarray of float64, shape (3, 3)
        Covariance of the center.
    rms_px : float
        Root mean square distance of edges to the fitted outline.
    fitted_radius_mm, fitted_radius_stderr_mm : float
        Radius fitted to the outlines; infinite error with one camera.
    cameras : tuple of str
        Cameras whose outline was used.
    """

    center_mm: Float64Array
    radius_mm: float
    covariance_mm2: Float64Array
    rms_px: float
    fitted_radius_mm: float
    fitted_radius_stderr_mm: float
    cameras: tuple[str, ...]


def find_outline(image: NDArray, camera: CameraPose, radius_mm: float) -> Float64Array | None:
    """Find a sphere near the rig's origin in an image, and edges on its outline.

    Parameters
    ----------
    image : ndarray of float, shape (H, W)
        Gray, linear, noise nearly uniform; the sphere is darker than its background.
    camera : CameraPose
    radius_mm : float
        Radius of the sphere.

    Returns
    -------
    ndarray of float64, shape (n, 2), or None
        Columns and rows of edges, px; None when no outline is found.
    """
    gray = np.sqrt(np.clip(np.asarray(image, np.float64), 0.0, None))  # uniform noise
    distance = float(np.linalg.norm(camera.center_mm))
    focal = float(camera.matrix[0, 0])
    start = _vote(gray, [focal * radius_mm / (distance * f) for f in (0.9, 0.95, 1.0, 1.05, 1.1)])
    if start is None:
        return None
    middle, radius_px = start
    direction = camera.rays(middle)
    range_mm = radius_mm / np.sin(np.arctan(radius_px / focal))
    center = camera.center_mm + range_mm * direction
    reach = max(EDGE_SEARCH_RADII * radius_px, MIN_EDGE_SEARCH_PX)
    for _ in range(3):
        edges = _edges(gray, camera, center, radius_mm, reach)
        if len(edges) < MIN_OUTLINE_EDGES:
            return None
        center, sigma, _ = _fit({"": edges}, {"": camera}, center, radius_mm)
        reach = max(MIN_EDGE_SEARCH_PX, min(reach / 2, 8.0 * sigma))
    for _ in range(2):
        edges = _fine_edges(np.asarray(image, np.float64), camera, center, radius_mm)
        if len(edges) < MIN_OUTLINE_EDGES:
            return None
        center, _, _ = _fit({"": edges}, {"": camera}, center, radius_mm)
    return edges


def locate_sphere(
    outlines: Mapping[str, Float64Array],
    cameras: Mapping[str, CameraPose],
    radius_mm: float,
    *,
    check_radius: bool = True,
) -> SpherePosition:
    """Locate one sphere from its outlines in one or several cameras.

    Parameters
    ----------
    outlines : mapping of str to ndarray, shape (n, 2)
        Edges by view name, see `find_outline`.
    cameras : mapping of str to CameraPose
    radius_mm : float
        Radius of the sphere, > 0.
    check_radius : bool
        Whether outlines that contradict the radius are an error.

    Returns
    -------
    SpherePosition

    Raises
    ------
    SphereError
        If the outline is missing, or the outlines of several cameras contradict the radius.
    """
    if not outlines or not radius_mm > 0:
        raise MirrorSphereError(
            f"sphere: got outlines of {len(outlines)} cameras and radius {radius_mm} mm, expected"
            " at least one outline and a radius > 0"
        )
    start = np.mean(
        [_fit_single_outline(edges, cameras[n], radius_mm) for n, edges in outlines.items()], axis=0
    )
    center, sigma, H = _fit(outlines, cameras, start, radius_mm)
    free_radius, free_stderr = np.inf, np.inf
    if len(outlines) > 1:
        free, free_sigma, free_H = _fit(outlines, cameras, center, radius_mm, free_radius=True)
        free_radius = float(free[3])
        free_stderr = float(free_sigma * np.sqrt(np.linalg.inv(free_H)[3, 3]))
        gap = abs(free_radius - radius_mm)
        if check_radius and gap > max(
            MAX_RADIUS_SIGMAS * free_stderr, MAX_RADIUS_MISFIT * radius_mm
        ):
            raise MirrorSphereError(
                f"radius_mm: got {radius_mm:g}, but the outlines in {len(outlines)} cameras "
                f"give {free_radius:.3f} ± {free_stderr:.3f} mm; measure the sphere, or "
                "calibrate the cameras"
            )
    residual = np.concatenate(
        [_outline_px(cameras[n], edges, center, radius_mm) for n, edges in outlines.items()]
    )
    covariance, rms = np.asarray(sigma**2 * np.linalg.inv(H)), float(np.sqrt(np.mean(residual**2)))
    free_fit = free_radius, free_stderr
    return SpherePosition(center[:3], radius_mm, covariance, rms, *free_fit, tuple(outlines))


def contour(
    camera: CameraPose, center_mm: Float64Array, radius_mm: float, count: int
) -> Float64Array:
    """Return points of a sphere's outline in an image, shape (count, 2); NaN behind the camera."""
    to_center = center_mm - camera.center_mm
    distance = float(np.linalg.norm(to_center))
    if distance <= radius_mm:
        raise MirrorSphereError(
            f"sphere at {center_mm.tolist()}: camera {camera.serial} is inside it"
        )
    axis = to_center / distance
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    turn = np.arange(count) * 2 * np.pi / count
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
    # The touching rays have the half angle asin(R / d): their circle has the radius R cos and is d
    # cos^2 away along the axis.
    sine = radius_mm / distance
    # where rays touch: the circle in which the polar plane cuts the sphere
    touch = camera.center_mm + distance * (1 - sine**2) * axis
    return camera.project(touch + radius_mm * np.sqrt(1 - sine**2) * ring)


def _vote(gray: Float64Array, radii_px: list[float]) -> tuple[Float64Array, float] | None:
    """Return center and radius of the dark disc that most edges point away from."""
    smooth = gaussian_filter(gray, 1.5)
    gy, gx = np.gradient(smooth)
    size = np.hypot(gx, gy)
    limit = np.quantile(size, 0.9)
    rows, columns = np.nonzero(size > max(limit, 1e-12))
    if not rows.size:
        return None
    ux, uy = gx[rows, columns] / size[rows, columns], gy[rows, columns] / size[rows, columns]
    shape = tuple(int(n / VOTE_CELL_PX) + 1 for n in gray.shape)
    best: tuple[float, Float64Array, float] | None = None
    for radius in radii_px:
        x = ((columns - radius * ux) / VOTE_CELL_PX).astype(int)
        y = ((rows - radius * uy) / VOTE_CELL_PX).astype(int)
        good = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
        votes = np.bincount(y[good] * shape[1] + x[good], minlength=shape[0] * shape[1])
        field = gaussian_filter(votes.reshape(shape).astype(float), max(0.03 * radius, 1.0))
        peak = int(np.argmax(field))
        if best is None or field.flat[peak] > best[0]:
            row, column = divmod(peak, shape[1])
            middle = (np.array([column, row]) + 0.5) * VOTE_CELL_PX
            best = float(field.flat[peak]), middle, radius
    return (best[1], best[2]) if best is not None else None


def _edges(
    gray: Float64Array, camera: CameraPose, center: Float64Array, radius_mm: float, reach: float
) -> Float64Array:
    """Return subpixel edges, dark inside, along normals of the expected outline."""
    outline, outward = _outline(camera, center, radius_mm)
    steps = np.arange(-reach - 2.0, reach + 2.0 + EDGE_STEP_PX / 2, EDGE_STEP_PX)
    places = outline[:, None] + steps[None, :, None] * outward[:, None]
    lines = map_coordinates(gray, [places[..., 1], places[..., 0]], order=1, mode="nearest")
    # slope of a line smoothed over about a pixel
    slope = gaussian_filter(lines, (0, 0.7 / EDGE_STEP_PX), order=(0, 1), mode="nearest")
    within = np.abs(steps) <= reach
    slope[:, ~within] = 0.0
    at = np.argmax(slope, axis=1)
    rows = np.arange(len(at))
    peak = slope[rows, at]
    fine = (at > 0) & (at < len(steps) - 1) & (peak > 0)
    left, right = slope[rows, at - 1], slope[rows, (at + 1) % len(steps)]
    bend = left - 2 * peak + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0)
    found = outline + (steps[at] + np.clip(shift, -1, 1) * EDGE_STEP_PX)[:, None] * outward
    inside = _in_image(found, gray.shape, 1.0)
    # edges much weaker than most are dropped: lights near the rim or behind it cause false ones
    strong = peak > 0.3 * np.median(peak[fine]) if fine.any() else fine
    background = np.median(lines[:, steps > 0])
    dark = lines.max(axis=1) < MAX_GLARE_RATIO * background
    return np.asarray(found[fine & inside & strong & dark])


def _fine_edges(
    image: Float64Array, camera: CameraPose, center: Float64Array, radius_mm: float
) -> Float64Array:
    """Return edges to a few hundredths of a pixel, near an outline known to about one.

    Just inside the rim a sphere mirrors the background next to it, then, as the square root of the
    distance, the background farther round: the slope of the mirrored background shifts the steepest
    point. Each line across the edge is therefore fitted by a straight background outside and by a
    constant, a root and a slope inside, blurred by a pixel; the edge is the position of the best
    fit.
    """
    outline, outward = _outline(camera, center, radius_mm)
    half = min(
        FINE_WINDOW_PX, 0.2 * float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).min())
    )
    steps = np.arange(-half, half + FINE_STEP_PX / 2, FINE_STEP_PX)
    places = outline[:, None] + steps[None, :, None] * outward[:, None]
    lines = map_coordinates(image, [places[..., 1], places[..., 0]], order=1, mode="nearest")
    shifts = np.arange(-FINE_SEARCH_PX, FINE_SEARCH_PX + FINE_STEP_PX / 2, FINE_STEP_PX)
    power = np.stack(
        [np.sum((lines @ _edge_basis(steps, at)) ** 2, axis=1) for at in shifts], axis=1
    )
    best = np.argmax(power, axis=1)
    rows = np.arange(len(best))
    fine = (best > 0) & (best < len(shifts) - 1)
    middle = np.clip(best, 1, len(shifts) - 2)
    left, peak, right = (power[rows, middle + k] for k in (-1, 0, 1))
    bend = left - 2 * peak + right
    part = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0)
    offset = shifts[middle] + np.clip(part, -1, 1) * FINE_STEP_PX
    found = outline + offset[:, None] * outward
    outside, within = lines[:, steps > 1.5].mean(axis=1), lines[:, steps < -1.5].mean(axis=1)
    background = np.median(outside)
    dark = lines.max(axis=1) < MAX_GLARE_RATIO**2 * background
    fine &= dark & (within < outside) & _in_image(found, image.shape, half)
    return np.asarray(found[fine])


@lru_cache(maxsize=512)
def _edge_basis_cached(steps: tuple[float, ...], at: float) -> Float64Array:
    s = np.array(steps)
    fine = np.arange(s[0] - 3.0, s[-1] + 3.0, 0.05)
    d = at - fine  # depth inside the rim
    inside = (d > 0).astype(float)
    root = np.sqrt(np.clip(d, 0.0, None))
    columns = np.stack([1 - inside, (1 - inside) * fine, inside, root, inside * d])
    blurred = gaussian_filter(columns, (0, PIXEL_BLUR_PX / 0.05), mode="nearest")
    basis = np.stack([np.interp(s, fine, column) for column in blurred], axis=1)
    return np.asarray(np.linalg.qr(basis)[0])


def _edge_basis(steps: Float64Array, at: float) -> Float64Array:
    """Return an orthonormal basis of lines with an edge at a position, shape (steps, 5)."""
    return _edge_basis_cached(tuple(np.round(steps, 6).tolist()), round(float(at), 6))


def _outline(
    camera: CameraPose, center: Float64Array, radius_mm: float
) -> tuple[Float64Array, Float64Array]:
    """Return points of the expected outline, and unit vectors out of it."""
    outline = contour(camera, center[:3], radius_mm, N_OUTLINE_ANGLES)
    outward = outline - outline.mean(axis=0)
    return outline, outward / np.linalg.norm(outward, axis=1, keepdims=True)


def _in_image(pixels: Float64Array, shape: tuple[int, ...], margin: float) -> BoolArray:
    height, width = shape
    low = (pixels > margin).all(axis=1)
    return np.asarray(
        low & (pixels[:, 0] < width - 1 - margin) & (pixels[:, 1] < height - 1 - margin)
    )


def _fit_single_outline(edges: Float64Array, camera: CameraPose, radius_mm: float) -> Float64Array:
    """Return a center from one outline, by the axis and angle of its cone."""
    rays = camera.rays(edges)
    # rays of a cone end in a plane: rays @ a = 1 with a along the axis
    a = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]
    cosine = min(1.0 / float(np.linalg.norm(a)), 1 - 1e-12)
    # |a| is 1 / cos of the cone's half angle, and the sine of the half angle is radius over range.
    range_mm = radius_mm / np.sqrt(1 - cosine**2)
    return np.asarray(camera.center_mm + range_mm * a / np.linalg.norm(a))


def _outline_px(
    camera: CameraPose, edges: Float64Array, sphere: Float64Array, radius_mm: float
) -> Float64Array:
    """Return the distance of edges outside the outline, px near the image's center."""
    radius = sphere[3] if len(sphere) == 4 else radius_mm
    to_center = sphere[:3] - camera.center_mm
    distance = np.linalg.norm(to_center)
    rays = camera.rays(edges)
    sine = np.linalg.norm(np.cross(rays, to_center / distance), axis=1)
    off = np.arctan2(sine, rays @ to_center / distance) - np.arcsin(min(radius / distance, 1.0))
    return np.asarray(camera.matrix[0, 0] * off)


def _fit(
    outlines: Mapping[str, Float64Array],
    cameras: Mapping[str, CameraPose],
    start: Float64Array,
    radius_mm: float,
    *,
    free_radius: bool = False,
) -> tuple[Float64Array, float, Float64Array]:
    """Return center (and radius), the edges' noise and the normal matrix of a robust fit."""
    sphere = np.append(start[:3], radius_mm) if free_radius else np.array(start[:3])

    def residuals(at: Float64Array) -> Float64Array:
        parts = [_outline_px(cameras[n], e, at, radius_mm) for n, e in outlines.items()]
        return np.concatenate(parts)

    sigma, H = 1.0, np.eye(len(sphere))
    for _ in range(MAX_SPHERE_STEPS):
        r = residuals(sphere)
        sigma = max(mad_sigma(r), 1e-6)
        w = np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(np.abs(r), 1e-12))
        J = np.empty((len(r), len(sphere)))
        for k in range(len(sphere)):
            step = np.zeros(len(sphere))
            step[k] = 1e-4
            J[:, k] = (residuals(sphere + step) - residuals(sphere - step)) / 2e-4
        H = (J * w[:, None]).T @ J
        change = np.linalg.solve(H + 1e-9 * np.eye(len(H)) * np.trace(H), -J.T @ (w * r))
        sphere = sphere + change
        if np.linalg.norm(change) < SPHERE_STEP_TOL_MM:
            break
    else:
        _log.warning(
            "mirror sphere: not converged after %d steps; last step %.2g mm, condition %.2g; "
            "check the outline in the images, and capture the sphere again",
            MAX_SPHERE_STEPS,
            np.linalg.norm(change),
            np.linalg.cond(H),
        )
    r = residuals(sphere)
    w = np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(np.abs(r), 1e-12))
    noise = float(np.sqrt((w * r**2).sum() / max(w.sum() - len(sphere), 1.0)))
    return sphere, noise, H
