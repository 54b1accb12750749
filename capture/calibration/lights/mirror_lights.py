"""Locate lights by their highlights on mirror spheres, seen by several cameras.

Each light is on the reflected ray of its highlight. All highlights together locate the lights, and
correct the spheres' centers within the errors of their outlines.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label
from scipy.optimize import linear_sum_assignment
from threadpoolctl import threadpool_limits

from capture.arrays import BoolArray, Float64Array, Int64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.lights.mirror_sphere import MirrorSphereError, SpherePosition, contour
from capture.calibration.lights.reflection import reflect, reflection_pixels, reflection_points
from capture.calibration.robust import huber_weights, mad_sigma

_log = logging.getLogger(__name__)

MIN_RIM_DISTANCE_PX = 1.5  # highlights closer to the outline are ignored
HIGHLIGHT_NOISE_SIGMAS = 8.0  # above the median in the sphere
# of the brightest pixel in the sphere: fainter spots are reflections of spots
MIN_HIGHLIGHT_PEAK = 0.02
# largest distance of a light from a reflected ray that it can have caused
LIGHT_GATE_MM = 60.0
MIN_HIGHLIGHT_CAMERAS = 2
MIN_HIGHLIGHTS = 3
# error of a highlight's centroid, whatever its size: noise, the surface's polish
MIN_HIGHLIGHT_STDERR_PX = 0.03
MAX_MIRROR_STEPS = 25
MIRROR_STEP_TOL = 1e-3  # square of the last step over its standard errors, all parameters together
DERIVATIVE_STEP_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SphereWindow:
    """Part of an image that shows a sphere; made once for a camera and a sphere.

    Attributes
    ----------
    rows, columns : slice
        Smallest box around it.
    inside : ndarray of bool
        Pixels of the window well inside the outline.
    """

    rows: slice
    columns: slice
    inside: BoolArray

    @classmethod
    def of(cls, camera: CameraPose, sphere: SpherePosition) -> SphereWindow:
        """Return the window of a sphere in a camera."""
        outline = contour(camera, sphere.center_mm, sphere.radius_mm, 90)
        size = np.array(camera.image_size)
        if not np.isfinite(outline).all():
            raise MirrorSphereError(
                f"sphere at {sphere.center_mm.tolist()}: behind {camera.serial}"
            )
        low = np.clip(np.floor(outline.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(outline.max(axis=0)) + 1, 0, size).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        if not x.size:
            empty = np.zeros((0, 0), bool)
            return cls(slice(0, 0), slice(0, 0), empty)
        rays = camera.rays(np.stack([x, y], axis=-1).astype(float))
        offset = sphere.center_mm - camera.center_mm
        distance = float(np.linalg.norm(offset))
        angle = np.arccos(np.clip(rays @ offset / distance, -1, 1))
        limit = np.arcsin(sphere.radius_mm / distance) - MIN_RIM_DISTANCE_PX / camera.matrix[0, 0]
        rows, columns = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
        return cls(rows, columns, angle < limit)


@dataclass(frozen=True, slots=True, eq=False)
class Highlights:
    """Bright spots of one camera in one sphere while some lights were on.

    Attributes
    ----------
    view : str
        Name of the camera.
    sphere : int
        Number of the sphere's position.
    lit : tuple of str
        Names of the lights that were on.
    pixels : ndarray of float64, shape (n, 2)
        Column and row of each spot, px.
    """

    view: str
    sphere: int
    lit: tuple[str, ...]
    pixels: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class LightPositions:
    """Positions of the lights.

    Attributes
    ----------
    names : tuple of str
    position_mm : ndarray of float64, shape (L, 3)
        Rig frame; the nominal position where not `valid`.
    covariance_mm2 : ndarray of float64, shape (L, 3, 3)
        0 where not `valid`.
    cameras, highlights : ndarray of int64, shape (L,)
        Number of cameras and highlights that locate each light.
    valid : ndarray of bool, shape (L,)
        At least 2 cameras and 3 highlights.
    unobserved : tuple of str
        Lights that were on and should have been visible, but never were: dead or not connected.
    swapped : dict of str to str
        Lights at whose position another one shone: by the name that was switched on, the name of
        the light whose nominal position was observed. Their positions are the observed ones.
    sigma_px : float
        Noise of a highlight's coordinate, estimated from the residuals.
    """

    names: tuple[str, ...]
    position_mm: Float64Array
    covariance_mm2: Float64Array
    cameras: Int64Array
    highlights: Int64Array
    valid: BoolArray
    unobserved: tuple[str, ...]
    swapped: dict[str, str]
    sigma_px: float

    @property
    def stderr_mm(self) -> Float64Array:
        """Standard errors, shape (L, 3); 0 where not `valid`."""
        return np.sqrt(np.clip(np.diagonal(self.covariance_mm2, axis1=1, axis2=2), 0, None))


def find_highlights(image: NDArray, window: SphereWindow) -> Float64Array:
    """Find the bright spots in a sphere.

    Parameters
    ----------
    image : ndarray of float, shape (H, W)
        Gray, linear, full resolution; saturated pixels keep their values.
    window : SphereWindow

    Returns
    -------
    ndarray of float64, shape (n, 2)
        Intensity-weighted centroid of each spot, px, brightest first.
    """
    part = np.asarray(image[window.rows, window.columns], np.float64)
    values = part[window.inside]
    if values.size < 9:
        return np.zeros((0, 2))
    usual = float(np.median(values))
    # the median deviation of a few levels of the converter may be 0
    quiet = values[np.abs(values - usual) <= np.quantile(np.abs(values - usual), 0.98)]
    sigma = max(mad_sigma(values - usual), float(quiet.std()))
    above = np.where(window.inside, part - usual, 0.0)
    limit = max(HIGHLIGHT_NOISE_SIGMAS * sigma, MIN_HIGHLIGHT_PEAK * float(above.max()), 1e-12)
    spots, count = label(above > limit, structure=np.ones((3, 3)))
    pixels, flux = [], []
    for k in range(1, count + 1):
        # its faint border belongs to a spot, too: without it the centroid is biased to bright
        # pixels
        spot = binary_dilation(spots == k) & ((spots == k) | (spots == 0))
        rows, columns = np.nonzero(spot)
        weight = np.clip(above[rows, columns], 0.0, None)
        flux.append(weight.sum())
        pixels.append([columns @ weight / weight.sum(), rows @ weight / weight.sum()])
    corner = np.array([window.columns.start, window.rows.start])
    found = np.array(pixels).reshape(-1, 2) + corner
    return found[np.argsort(flux)[::-1]]


def locate_lights(
    highlights: Sequence[Highlights],
    cameras: Mapping[str, CameraPose],
    spheres: Mapping[int, SpherePosition],
    nominal: Mapping[str, Float64Array],
    *,
    light_radius_mm: float = 10.0,
    nominal_stderr_mm: float | None = None,
) -> LightPositions:
    """Locate lights by their highlights.

    Parameters
    ----------
    highlights : sequence of Highlights
        Highlights of all cameras, spheres and groups of lights.
    cameras : mapping of str to CameraPose
        Calibrated, by view name.
    spheres : mapping of int to SpherePosition
    nominal : mapping of str to array_like, shape (3,)
        Expected position of each light, mm; it identifies highlights and starts the fit.
    light_radius_mm : float
        Radius of the lights' discs, mm, >= 0; it determines the size of their images.
    nominal_stderr_mm : float, optional
        Standard deviation of the lights about their nominal positions, mm: a prior for lights with
        few highlights. None uses no prior.

    Returns
    -------
    LightPositions

    Raises
    ------
    SphereError
        If no highlight belongs to any light.
    """
    scene = _Scene(cameras, spheres, nominal)
    names, start = scene.names, scene.nominal_mm.copy()
    matched, answers, unseen = scene.match(highlights)
    if not matched:
        raise MirrorSphereError(
            f"highlights: none of {sum(len(s.pixels) for s in highlights)} spots is where one "
            f"of the {len(names)} lights would appear; check the spheres, the cameras and the "
            "exposure"
        )
    for name, other in answers.items():
        start[names.index(name)] = nominal[other]
    count = np.bincount([m[0] for m in matched], minlength=len(names))
    pairs = {(light, view) for light, view, _, _ in matched}
    by = np.bincount([light for light, _ in pairs], minlength=len(names))
    valid = (count >= MIN_HIGHLIGHTS) & (by >= MIN_HIGHLIGHT_CAMERAS)
    used = [m for m in matched if valid[m[0]]]
    if not used:
        raise MirrorSphereError(
            f"highlights: no light was observed by {MIN_HIGHLIGHT_CAMERAS} cameras in "
            f"{MIN_HIGHLIGHTS} images; show the sphere at more positions, to more cameras"
        )
    with threadpool_limits(limits=1, user_api="blas"):  # many small matrices
        position, covariance, sigma = scene.adjust(used, start, light_radius_mm, nominal_stderr_mm)
    position[~valid] = scene.nominal_mm[~valid]
    return LightPositions(names, position, covariance, by, count, valid, unseen, answers, sigma)


_Matched = tuple[int, str, int, Float64Array]  # light, view, sphere, pixel


class _Scene:
    """Cameras, spheres and lights: match the spots and adjust the positions."""

    def __init__(
        self,
        cameras: Mapping[str, CameraPose],
        spheres: Mapping[int, SpherePosition],
        nominal: Mapping[str, Float64Array],
    ) -> None:
        self.cameras, self.spheres, self.names = cameras, spheres, tuple(nominal)
        self.nominal_mm = np.array([np.asarray(place, float) for place in nominal.values()])

    def match(
        self, highlights: Sequence[Highlights]
    ) -> tuple[list[_Matched], dict[str, str], tuple[str, ...]]:
        """Return the light of each spot, swapped lights, and lights never observed."""
        names, matched = self.names, list[_Matched]()
        expected: Counter[int] = Counter()
        found: Counter[int] = Counter()
        instead: Counter[tuple[int, int]] = Counter()
        strange: list[tuple[int, _Matched]] = []
        for shot in highlights:
            camera, sphere = self.cameras[shot.view], self.spheres[shot.sphere]
            lit = [names.index(name) for name in shot.lit]
            places = self.nominal_mm[lit]
            where = reflection_pixels(camera, sphere.center_mm, sphere.radius_mm, places)
            # lights well in view: their highlight is not compressed at the rim
            visible = _is_clear_of_rim(camera, sphere, where) if len(lit) else np.zeros(0, bool)
            expected.update(k for k, ok in zip(lit, visible, strict=True) if ok)
            if not len(shot.pixels):
                continue
            miss = _ray_distance_mm(camera, sphere, shot.pixels, self.nominal_mm)
            rows, columns = linear_sum_assignment(np.minimum(miss[:, lit], 10 * LIGHT_GATE_MM))
            free_spots = set(range(len(shot.pixels)))
            free_lights = set(lit)
            for spot, column in zip(rows, columns, strict=True):
                if miss[spot, lit[column]] < LIGHT_GATE_MM:
                    matched.append((lit[column], shot.view, shot.sphere, shot.pixels[spot]))
                    found[lit[column]] += 1
                    free_spots.discard(spot)
                    free_lights.discard(lit[column])
            missing = [k for k in free_lights if visible[lit.index(k)]]
            if len(missing) == 1:
                for spot in free_spots:
                    other = int(np.argmin(miss[spot]))
                    if miss[spot, other] < LIGHT_GATE_MM and other not in lit:
                        instead[missing[0], other] += 1
                        shown = (missing[0], shot.view, shot.sphere, shot.pixels[spot])
                        strange.append((other, shown))
        answers: dict[str, str] = {}
        for (light, other), times in instead.most_common():
            if times > found[light] and times > 0.5 * expected[light]:
                answers.setdefault(names[light], names[other])
        matched += [m for other, m in strange if answers.get(names[m[0]]) == names[other]]
        unseen = tuple(
            names[k]
            for k in range(len(names))
            if expected[k] >= MIN_HIGHLIGHTS and not found[k] and names[k] not in answers
        )
        return matched, answers, unseen

    def adjust(
        self,
        matched: Sequence[_Matched],
        start: Float64Array,
        light_radius_mm: float,
        nominal_stderr_mm: float | None,
    ) -> tuple[Float64Array, Float64Array, float]:
        """Return all lights' positions and covariances and the rms of a coordinate.

        Newton's method on the lights and on the spheres' centers, which the outlines constrain,
        too.
        """
        numbers = sorted(self.spheres)
        lights, light_of = np.unique([m[0] for m in matched], return_inverse=True)
        base = 3 * len(lights)
        total = base + 3 * len(numbers)
        position = start.copy()
        outlines = [self.spheres[n] for n in numbers]
        centers = np.array([sphere.center_mm for sphere in outlines])
        # The outlines act as a normal prior of each sphere's center.
        stiffness = [np.linalg.inv(s.covariance_mm2 + 1e-12 * np.eye(3)) for s in outlines]
        sphere_of = np.array([numbers.index(m[2]) for m in matched])
        columns = np.stack([3 * light_of, base + 3 * sphere_of], axis=1)[..., None] + np.arange(3)
        columns = columns.reshape(-1, 6)
        H, r, robust, count = np.eye(total), np.zeros((1, 2)), np.ones(1), 1.0
        for _ in range(MAX_MIRROR_STEPS):
            r, J = self._rows(matched, centers[sphere_of], position[lights][light_of])
            # within a spot narrower than a pixel, the position in the pixel is unknown
            width = 2 * light_radius_mm * np.linalg.norm(J[:, :, :3], axis=2)
            usual = np.sqrt(MIN_HIGHLIGHT_STDERR_PX**2 + np.clip(1 - width, 0, None) ** 3 / 12)
            z = r / usual
            sigma = max(mad_sigma(z), 1e-6)
            robust = huber_weights(np.linalg.norm(z, axis=1) / sigma)
            count = 2 * robust.sum() - total
            scale = np.sqrt((robust[:, None] * z**2).sum() / max(float(count), 1.0))
            w = robust[:, None] / (scale * usual) ** 2
            H, g = np.zeros((total, total)), np.zeros(total)
            blocks = np.einsum("ni,nij,nik->njk", w, J, J)
            np.add.at(H, (columns[:, :, None], columns[:, None, :]), blocks)
            np.add.at(g, columns, np.einsum("ni,nij,ni->nj", w, J, r))
            for s, sphere in enumerate(outlines):
                at = slice(base + 3 * s, base + 3 * s + 3)
                H[at, at] += stiffness[s]
                g[at] += stiffness[s] @ (centers[s] - sphere.center_mm)
            if nominal_stderr_mm is not None:
                H[np.arange(base), np.arange(base)] += 1 / nominal_stderr_mm**2
                g[:base] += (position - start)[lights].ravel() / nominal_stderr_mm**2
            step = -np.linalg.solve(H, g)
            position[lights] += step[:base].reshape(-1, 3)
            centers += step[base:].reshape(-1, 3)
            if step @ H @ step < MIRROR_STEP_TOL:
                break
        else:
            _log.warning(
                "positions of lights: not converged after %d steps, last step %.2g standard errors",
                MAX_MIRROR_STEPS,
                np.sqrt(step @ H @ step),
            )
        inverse = np.linalg.inv(H)
        covariance = np.zeros((len(start), 3, 3))
        for k, light in enumerate(lights):
            covariance[light] = inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        rms = float(np.sqrt((robust[:, None] * r**2).sum() / max(float(count), 1.0)))
        return position, covariance, rms

    def _rows(
        self, matched: Sequence[_Matched], centers_mm: Float64Array, lights_mm: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return residuals, px, shape (n, 2), and their derivatives, shape (n, 2, 6)."""
        views = np.array([m[1] for m in matched])
        radius_mm = next(iter(self.spheres.values())).radius_mm
        each = np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
        steps = DERIVATIVE_STEP_MM * each[:, None]
        names = sorted(set(views))
        eyes = np.array([self.cameras[view].center_mm for view in views])
        lights, centers = lights_mm + steps[..., :3], centers_mm + steps[..., 3:]
        point, seen = reflection_points(
            np.broadcast_to(eyes, lights.shape).reshape(-1, 3),
            centers.reshape(-1, 3),
            radius_mm,
            lights.reshape(-1, 3),
        )
        point, seen = point.reshape(lights.shape), seen.reshape(lights.shape[:2])
        found = np.empty((*lights.shape[:2], 2))
        for name in names:
            mine = views == name
            found[:, mine] = self.cameras[name].project(point[:, mine])
        residual = found[0] - np.array([m[3] for m in matched])
        J = np.moveaxis((found[1:7] - found[7:]) / (2 * DERIVATIVE_STEP_MM), 0, -1)
        lost = ~(seen.all(axis=0) & np.isfinite(found).all(axis=(0, 2)))
        residual[lost], J[lost] = 0.0, 0.0
        return residual, J


def _is_clear_of_rim(camera: CameraPose, sphere: SpherePosition, pixels: Float64Array) -> BoolArray:
    """Return the pixels in the inner nine tenths of a sphere and in the image."""
    inside = np.zeros(len(pixels), bool)
    good = np.isfinite(pixels).all(axis=1)
    good &= (pixels > 1).all(axis=1) & (pixels < np.array(camera.image_size) - 2).all(axis=1)
    if good.any():
        offset = sphere.center_mm - camera.center_mm
        distance = float(np.linalg.norm(offset))
        cosine = camera.rays(pixels[good]) @ offset / distance
        limit = np.cos(0.9 * np.arcsin(sphere.radius_mm / distance))
        inside[good] = cosine > limit
    return inside


def _ray_distance_mm(
    camera: CameraPose, sphere: SpherePosition, pixels: Float64Array, lights_mm: Float64Array
) -> Float64Array:
    """Return the distance of each light from each reflected ray, mm, shape (spots, lights)."""
    point, direction, hit = reflect(camera, pixels, sphere.center_mm, sphere.radius_mm)
    to_light = lights_mm[None] - point[:, None]
    along = np.einsum("slk,sk->sl", to_light, direction)
    gap = np.linalg.norm(to_light - along[..., None] * direction[:, None], axis=-1)
    return np.asarray(np.where(hit[:, None] & (along > 0), gap, np.inf).clip(max=1e9))
