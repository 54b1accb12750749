"""Readings of the fiber probe on voxel skin of a person, and voxel skin before single fibers."""

from dataclasses import dataclass
from math import cos, pi, sin
from typing import Any, Final

import numpy as np

from capture.rig import Rig
from model import spectra
from rigsim.arrays import Float64Array
from rigsim.fiber.probe_profile import probe_fibers, smooth_profile
from rigsim.fiber.probe_tissue import CONTACT_PRESSURE_MBAR, SKIN_WAVELENGTHS_NM, TissueError
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.mitsuba.scene_radiance import look_at
from rigsim.scenes.reference.flat_layers import render_voxels
from rigsim.scenes.reference.patch import SKIN_HALF_MM, draw_patch
from rigsim.scenes.reference.placed_paths import HeadPlace, UnevenLayers, trace_placed_paths
from rigsim.subject.person_skin import PersonSkin
from rigsim.subject.tissue_pressure import blood_ratio
from rigsim.tissue.skin_layers import TissueProperties, skin_coefficients, skin_layer_stack

FIELD_MM: Final = 16.0
"""Side of the skin below the probe, mm; its margin lies beyond."""
PROBE_VOXEL_MM: Final = 0.25
MASK_HEIGHT_MM: Final = 1.0
"""Height of the opaque plate whose hole is the source."""
HOLE_CORNERS: Final = 64
FIBER_PIXELS: Final = 16
"""Pixels across a detection fiber."""


@dataclass(frozen=True, slots=True, eq=False)
class VoxelReadings:
    """Noise-free readings of the probe in the camera's bands at some places of a person's skin."""

    even_per_mm2: Float64Array
    """R_f in 1/mm^2 of flat layers with the site's mean pigment and blood, shape (F, 3)."""
    even_stderr: Float64Array
    """Standard error of `even_per_mm2`, same shape."""
    ratio: Float64Array
    """R_f of the voxels at each place over that of the flat layers, shape (places, F, 3)."""
    ratio_stderr: Float64Array
    """Standard error of `ratio`, same shape."""

    @property
    def reflectance_per_mm2(self) -> Float64Array:
        """R_f in 1/mm^2 of the voxels, shape (places, F, 3)."""
        return self.ratio * self.even_per_mm2


def read_person(
    person: PersonSkin,
    site: str,
    rig: Rig,
    places: tuple[HeadPlace, ...],
    *,
    photons: int,
    laid_paths: int,
    seed: int,
) -> VoxelReadings:
    """Return the probe's readings on voxels of a person's skin, pressed by the probe's suction.

    Parameters
    ----------
    person, site
        As for `rigsim.subject.person_skin.skin_maps`.
    rig
        The probe.
    places
        Places of the head around the site.
    photons
        Photons at each of `SKIN_WAVELENGTHS_NM`.
    laid_paths
        Paths laid into the voxels for each fiber and wavelength.
    seed
        Seed of the photons, >= 0.

    Returns
    -------
    VoxelReadings
        Flat layers are smoothed over distance, as in the simulator.

    Raises
    ------
    rigsim.fiber.probe_tissue.TissueError
        The rig has no probe.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> read = read_person(
    ...     PersonSkin.of_preset("III"), "cheek", load_rig("probe"), (HeadPlace(),),
    ...     photons=400, laid_paths=20, seed=0
    ... )
    >>> read.reflectance_per_mm2.shape
    (1, 28, 3)
    """
    if rig.probe is None:
        raise TissueError(f"rig {rig.name!r}: expected a contact probe")
    fibers = probe_fibers(rig.probe)
    weights = spectra.band_weights(
        rig.views[0].spectral_sensitivity, rig.lights[0].illuminant, SKIN_WAVELENGTHS_NM
    )
    pressed = float(blood_ratio(max(rig.probe.suction_mbar, CONTACT_PRESSURE_MBAR)))
    patch = draw_patch(person, site, field_mm=FIELD_MM, voxel_mm=PROBE_VOXEL_MM)
    flat = person.at(site)
    melanin, blood = (part.astype(np.float64) for part in (patch.melanin, pressed * patch.blood))
    runs = []
    for k, wavelength_nm in enumerate(SKIN_WAVELENGTHS_NM):
        stack = skin_layer_stack(wavelength_nm, flat.c_m, pressed * flat.c_hd, flat.tissue)
        absorption = columns(wavelength_nm, melanin, blood, flat.tissue)
        skin = UnevenLayers(stack, absorption[-len(stack.layers) :], patch.voxel_mm)
        rng = np.random.default_rng([seed, k])
        runs.append(
            trace_placed_paths(
                skin, fibers, places, photons=photons, laid_paths=laid_paths, rng=rng
            )
        )
    batches = np.einsum("wbf,wc->bfc", np.stack([run.even_per_mm2 for run in runs]), weights)
    even, stderr = smooth_profile(np.array(fibers.radii_mm), batches)
    shares = np.stack([run.even_per_mm2.mean(axis=0) for run in runs])[..., None] * weights[:, None]
    shares /= shares.sum(axis=0)
    ratio = np.einsum("wfc,wfp->pfc", shares, np.stack([run.ratio for run in runs]))
    variance = np.stack([np.square(run.ratio_stderr) for run in runs])
    spread = np.sqrt(np.einsum("wfc,wfp->pfc", np.square(shares), variance))
    return VoxelReadings(even, stderr, ratio, spread)


def columns(
    wavelength_nm: float, melanin: Float64Array, blood: Float64Array, tissue: TissueProperties
) -> Float64Array:
    """Return the absorption of upper and basal epidermis and of the dermis, shape (3, n, n)."""
    found = skin_coefficients(wavelength_nm, melanin, blood, tissue)
    return np.stack([found.upper, found.basal, found.dermis])


@dataclass(frozen=True, slots=True)
class RenderedFiber:
    """R_f of one fiber by the integrator `tissue`, in 1/mm^2, and its standard error."""

    reflectance_per_mm2: float
    stderr: float


def render_fiber(
    scene: dict[str, Any], place: HeadPlace, *, radius_mm: float, core_mm: float, samples: int
) -> RenderedFiber:
    """Render the light in one fiber from a parallel beam along the normal.

    Parameters
    ----------
    scene
        Skin for `tissue` with the boundary at height 0; its lights and sensor are replaced.
    place
        Place of the source, and direction to the fiber.
    radius_mm
        Distance of the fiber, mm.
    core_mm
        Diameter of both cores, mm. The fiber collects light along the normal.
    samples
        Samples per pixel, of `FIBER_PIXELS` across.
    """
    kept = {name: part for name, part in scene.items() if name != "sensor" and name[:5] != "light"}
    turn = np.radians(place.angle_deg)
    at = place.x_mm + radius_mm * cos(turn), place.y_mm + radius_mm * sin(turn)
    half = 0.5 * core_mm
    corners = 0.5 + np.arange(HOLE_CORNERS)
    hole = np.stack(
        [np.cos(2.0 * pi * corners / HOLE_CORNERS), np.sin(2.0 * pi * corners / HOLE_CORNERS)],
        axis=1,
    )
    # a polygon of the disc's area
    hole *= half * np.sqrt(2.0 * pi / HOLE_CORNERS / sin(2.0 * pi / HOLE_CORNERS))
    hole += [place.x_mm, place.y_mm]
    kept |= {
        "mask": {
            "type": "mesh",
            "mesh": _plate(hole),
            "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        },
        "light": {"type": "directional", "direction": [0.0, 0.0, -1.0], "irradiance": 1.0},
        "sensor": {
            "type": "orthographic",
            "near_clip": 1e-3,
            "to_world": look_at((*at, 0.5 * MASK_HEIGHT_MM), (*at, 0.0), (0.0, 1.0, 0.0))
            @ np.diag([half, half, 1.0, 1.0]),
            "film": {
                "type": "hdrfilm",
                "width": FIBER_PIXELS,
                "height": FIBER_PIXELS,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        },
    }
    fine = (np.arange(8 * FIBER_PIXELS) + 0.5) / (4 * FIBER_PIXELS) - 1.0
    inside = (np.hypot(fine[:, None], fine) <= 1.0).astype(np.float64)
    share = inside.reshape(FIBER_PIXELS, 8, FIBER_PIXELS, 8).mean(axis=(1, 3))
    share /= share.sum()
    each = []
    for seed in range(N_RENDERS):
        image = render_voxels(kept, samples=samples, seed=seed)[..., -1]
        # exitance of a Lambertian exit over the source's power
        each.append(pi * float((share * image).sum()) / (pi * half * half))
    return RenderedFiber(float(np.mean(each)), float(np.std(each, ddof=1) / np.sqrt(len(each))))


N_RENDERS: Final = 16
"""Independent renders, which give the standard error."""


def _plate(hole: Float64Array) -> Mesh:
    """Return a plate with a hole: triangles between corners of the hole and of a far polygon."""
    count = len(hole)
    middle = hole.mean(axis=0)
    far = middle + (hole - middle) * (SKIN_HALF_MM / np.abs(hole - middle).max())
    xyz = np.column_stack([np.concatenate([hole, far]), np.full(2 * count, MASK_HEIGHT_MM)])
    k = np.arange(count)
    after = (k + 1) % count
    faces = np.concatenate(
        [
            np.stack([k, k + count, after + count], axis=1),
            np.stack([k, after + count, after], axis=1),
        ]
    )
    uv = 0.5 * (xyz[:, :2] / (2.0 * SKIN_HALF_MM) + 1.0)
    return build_mesh(xyz, faces.tolist(), uv)
