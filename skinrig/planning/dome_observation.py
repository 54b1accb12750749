"""Simulated observation of a face by the dome: visibility and noise per light and camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.plan.dome import DOME_EXPOSURES_S
from capture.rig import Rig
from reconstruction.lumitexels.samples import MIN_VISIBLE_COSINE
from reconstruction.photometric_stereo import light_selection
from reconstruction.photometric_stereo.light_selection import FisherInformation
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates as surface_estimates
from reconstruction.surface import model_normals
from rigsim.light.lateral import scatter_laterally
from rigsim.light.led_light import white_intensity
from rigsim.light.surface_brdf import skin_surface
from rigsim.mitsuba.olat import RAY_OFFSET_MM
from rigsim.population import files as subject_file
from rigsim.render import Caster
from rigsim.sensor import make_sensor
from skinrig.arrays import BoolArray, Float64Array, FloatArray

FACE_POINTS = 1500
"""Number of sampled points of the face."""
LIGHT_ERROR = 0.015
"""Relative error per light that all cameras share: residual specular reflection, intensity of the
light, penumbra."""
MEDIAN_MISPLACEMENT_RATIO = 0.6
"""Misplacement of samples in the median error of a face, over that of the stated standard errors.

Those are set by their coverage of 68 %; few badly placed samples raise them, not the median. Set on
sessions of II, seed 752 (320 pixels), and III, 750 (256 pixels).
"""
BLUR_PX = 1.0
"""Standard deviation of the Gaussian blur of an albedo estimate, px, per direction.

It models pixel size, interpolation, oblique view and registration errors. R_d of simulated faces of
seeds 1 to 3 (types V, I and IV) was nearest to ground truth blurred by 0.9 to 1.05 of it.
"""
TEXTURE_TEXELS = 512
"""Side of the face's maps, texels; they must resolve albedo finer than the camera's pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DomeObservation:
    """Visibility and noise of P face points for L lights and V cameras."""

    normals: Float64Array
    """(P, 3) unit normals."""
    to_light: Float64Array
    """(P, L, 3) unit vectors to the lights."""
    rate: Float64Array
    """(P, L) light of a sample, full scales of the sensor per second."""
    usable: BoolArray
    """(P, L, V): the sample is neither shadowed, grazing nor in the highlight."""
    lit: BoolArray
    """(P, L): the point is visible from the light."""
    seen: BoolArray
    """(P, V): the point is visible from the camera."""
    area_mm2: Float64Array
    """(P,) surface area that a point represents."""
    systematic_rad: Float64Array
    """(P,) error of the normal that does not decrease with more samples."""
    unresolved: Float64Array
    """(P, 3) relative error of the albedo, camera RGB, by averaging over pixels."""
    r_d: Float64Array
    """(P, 3) albedo, camera RGB."""
    pixel_mm: float
    full_well_e: float
    read_noise_e: float

    def information(
        self, views: Sequence[int], exposures_s: Sequence[float] = DOME_EXPOSURES_S
    ) -> FisherInformation:
        """Return the Fisher information of each point per light, over a subset of the cameras.

        Parameters
        ----------
        views
            Numbers of the cameras.
        exposures_s
            Exposure times of each light, s; their samples are merged.
        """
        variance = _relative_variance(self.rate, exposures_s, self.full_well_e, self.read_noise_e)
        cameras = np.count_nonzero(self.usable[..., list(views)], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            noise = np.where(cameras > 0, variance / cameras, np.inf)
        enough = self.seen[:, list(views)].sum(-1) >= surface_estimates.MIN_VIEWS
        noise = np.where(enough[:, None], noise + LIGHT_ERROR**2, np.inf)
        return light_selection.fisher_information(
            self.normals,
            self.to_light,
            noise,
            reaches=self.lit & enough[:, None],
            importance=self.area_mm2,
            systematic_rad=self.systematic_rad,
        )


def simulate_observation(
    rig: Rig, subject: str, *, seed: int = 0, points: int | None = None
) -> DomeObservation:
    """Simulate which points of a face the dome observes, and with which noise.

    Parameters
    ----------
    rig
        The dome with nominal geometry.
    subject
        Preset of the face, see `rigsim.subject.PRESET_NAMES`.
    seed
        Random seed of the face and of the points.
    points
        Number of points; None: `FACE_POINTS`.
    """
    points = FACE_POINTS if points is None else points
    face = subject_file.load_subject(subject).face(seed=seed, size=TEXTURE_TEXELS)
    texels = np.flatnonzero(face.atlas.covered & (face.hair < 0.5))
    along_u, along_v = face.atlas.texel_mm()
    area = (along_u * along_v).reshape(-1)[texels]
    rng = np.random.default_rng([seed, 17])
    drawn = texels[rng.choice(len(texels), points, p=area / area.sum())]  # evenly over the skin
    place = face.atlas.position_mm.reshape(-1, 3)[drawn].astype(np.float64)
    normal = face.atlas.normal.reshape(-1, 3)[drawn].astype(np.float64)
    view = rig.views[0]
    surface = skin_surface(face, view.spectral_sensitivity, rig.lights[0].illuminant)
    rgb = surface.r_d.reshape(-1, 3)[drawn].astype(np.float64)
    r_d = rgb.mean(axis=-1)

    caster = Caster(face.mesh)
    start = place + RAY_OFFSET_MM * normal
    lights = np.array([light.position_mm for light in rig.lights], np.float64)
    views = np.array([one.position_mm for one in rig.views], np.float64)
    to_light, light_mm, lit = _trace_to_positions(caster, start, normal, lights)
    to_view, _, seen = _trace_to_positions(caster, start, normal, views)
    cos_light = np.einsum("plk,pk->pl", to_light, normal)
    cos_view = np.einsum("pvk,pk->pv", to_view, normal)
    steep = cos_light > model_normals.MIN_NORMAL_COS_LIGHT
    facing = cos_view > model_normals.MIN_NORMAL_COS_VIEW
    half = to_light[:, :, None] + to_view[:, None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    matte = np.einsum("plvk,pk->plv", half, normal) < math.cos(
        surface_estimates.HIGHLIGHT_HALF_ANGLE_RAD
    )

    white = np.array([white_intensity(light, view).mean() for light in rig.lights])
    # diffuse reflection of a point light: R_d I cos(theta) / d^2, in full scales per second
    rate = r_d[:, None] * white * cos_light / light_mm**2
    chip = make_sensor(view)
    usable = (lit & steep)[:, :, None] & (seen & facing)[:, None] & matte
    # similar triangles: size on the subject = size on the sensor x distance / focal length; a cell
    # of the color filter has two sensor pixels per side
    pixel = float(
        2.0 * np.median(np.linalg.norm(views, axis=-1)) * 1e-3 * view.pixel_um / view.focal_mm
    )  # mm
    return DomeObservation(
        normal,
        to_light,
        rate,
        usable,
        lit,
        seen,
        np.ones(len(place)),
        np.hypot(
            MEDIAN_MISPLACEMENT_RATIO
            * surface_errors.POSITION_SIGMA_PX
            * pixel
            * _normal_bend_rate(face, drawn, pixel),
            surface_errors.UNRESOLVED_RELIEF_RAD,
        ),
        _gaussian_mean(surface.r_d, face.atlas, BLUR_PX * pixel)[drawn] / rgb - 1.0,
        rgb,
        pixel,
        chip.full_well_e,
        chip.read_noise_e,
    )


def _trace_to_positions(
    caster: Any, start: Float64Array, normal: Float64Array, positions_mm: Float64Array
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return unit vectors, distances (mm) and unobstructed visibility from points to positions.

    As in the reconstruction, a position so low over the surface that a sample of it is not used
    does not count as visible.
    """
    away = positions_mm[None] - start[:, None]
    length = np.linalg.norm(away, axis=-1)
    way = away / length[..., None]
    front = np.einsum("pqk,pk->pq", way, normal) > MIN_VISIBLE_COSINE
    free = np.zeros(front.shape, np.bool_)
    point, place = np.nonzero(front)
    free[point, place] = ~caster.is_blocked(
        start[point], way[point, place], 0.999 * length[point, place]
    )
    return way, length, free


def _relative_variance(
    rate: Float64Array, exposures_s: Sequence[float], full_well_e: float, read_noise_e: float
) -> Float64Array:
    """Return the relative variance of a merged exposure series."""
    information = np.zeros(rate.shape)
    # brackets are merged by inverse variance, so that the information of the unsaturated ones adds:
    # (N / sigma)^2 with N electrons and sigma^2 = N (shot noise) + read noise^2
    for seconds in exposures_s:
        electrons = np.maximum(rate, 0.0) * seconds * full_well_e
        kept = (electrons > 0) & (electrons < 0.95 * full_well_e)
        information += np.where(kept, electrons**2 / (electrons + read_noise_e**2), 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(information > 0, 1.0 / information, np.inf))


def _gaussian_mean(r_d: FloatArray, atlas: Any, sigma_mm: float) -> Float64Array:
    """Blur an albedo map by a Gaussian over the surface; (N * N, 3)."""
    covered = atlas.covered[..., None]
    field = np.where(covered, r_d, 0.0).astype(np.float32)
    spread = scatter_laterally(field, atlas, [sigma_mm], np.ones((field.shape[-1], 1)))
    return np.asarray(spread.reshape(-1, field.shape[-1]), np.float64)


def _normal_bend_rate(face: Any, texels: NDArray[np.intp], pixel_mm: float) -> Float64Array:
    """Return the curvature of the face at texels, rad/mm, over edges of the scan's length."""
    mesh = face.mesh
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    turn = np.linalg.norm(mesh.normals[edges[:, 0]] - mesh.normals[edges[:, 1]], axis=1)
    apart = np.linalg.norm(mesh.vertices_mm[edges[:, 0]] - mesh.vertices_mm[edges[:, 1]], axis=1)
    squared = np.square(turn / np.maximum(apart, 0.25 * pixel_mm))
    total, count = np.zeros(len(mesh.vertices_mm)), np.zeros(len(mesh.vertices_mm))
    for side in (0, 1):
        np.add.at(total, edges[:, side], squared)
        np.add.at(count, edges[:, side], 1.0)
    bend = np.sqrt(total / np.maximum(count, 1.0))
    corner = mesh.faces[face.atlas.prim.reshape(-1)[texels]]
    return np.asarray(bend[corner].mean(axis=1))
