"""Render a fitted skin model: ray tracing, then shading by the fitted maps at the hit points.

Geometry, texture coordinates and shadows come from `rigsim.render`; what a point reflects comes
from `model.skin_reflectance`: direct light, and with a `SkinExchange` light that skin reflects onto
skin. Radiance is relative to that of a perfect
white Lambertian patch facing a light of intensity 1, at the position and distance where the
light's intensity is stated (see `skinrig.rendering.lights`)::

    L = sum over lights of  w V cos(theta) (pi f_surface + F_t(light) F_t(view) R_d)

with w the white patch's value and V the visible fraction of the light. With subsurface scattering,
R_d F_t(light) is replaced by the dipole's sum over the skin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from model.skin_reflectance import lobe_brdf, transmittance
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.render import Caster, GBuffer, trace
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.errors import require_choice
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.camera import Camera, RenderingError
from skinrig.rendering.geometry import FittedSurface, SurfacePointSamples
from skinrig.rendering.interior import Interior, Lighting
from skinrig.rendering.lights import Light
from skinrig.rendering.transport import ReturningLight, SkinExchange

Subsurface = Literal["local", "dipole", "none"]
"""Subsurface light leaves at its point of entry, is scattered by the dipole, or is omitted."""

BAND_RAYS: Final = 1 << 18
"""Camera rays per batch; limits memory."""
SUBPIXELS_PER_SIDE: Final = 2
SHADOW_SAMPLES: Final = 4
"""Shadow rays to points of a light's disc, per camera ray."""
MIN_LIT_FRACTION: Final = 0.999
"""Minimum visible fraction of a light that counts as fully visible."""
MIN_OUTSIDE_FRACTION: Final = 0.5
"""Minimum fraction of camera rays on the mesh that must hit its outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A rendered image with its components, averaged over pixels; row 0 is the top.

    Attributes
    ----------
    radiance
        Sum of the two below, (H, W, 3); see this module for its unit.
    diffuse
        Radiance of subsurface light, (H, W, 3).
    surface
        Radiance of specular reflection, (H, W, 3).
    coverage
        Fraction of each pixel that is skin, (H, W), 0 to 1.
    covered
        Pixels entirely on measured skin, (H, W).
    lit
        Covered pixels all of whose rays have full visibility of each light that they face.
    uv
        Mean texture coordinates, (H, W, 2); (0, 0) outside the skin.
    subsurface
        Treatment of subsurface light.
    """

    radiance: Float32Array
    diffuse: Float32Array
    surface: Float32Array
    coverage: Float32Array
    covered: BoolArray
    lit: BoolArray
    uv: Float32Array
    subsurface: Subsurface


def render_surface(
    surface: FittedSurface,
    camera: Camera,
    lights: Light | Sequence[Light],
    *,
    subsurface: Subsurface = "local",
    subpixels: int = SUBPIXELS_PER_SIDE,
    shadow_samples: int = SHADOW_SAMPLES,
    blockers: Mesh | None = None,
    caster: Caster | None = None,
    interior: Interior | None = None,
    exchange: SkinExchange | None = None,
    progress: Callable[[str], None] | None = None,
) -> Rendering:
    """Render a fitted model under lights.

    Parameters
    ----------
    surface
        The model on a mesh, mm, rig frame.
    camera
        See `skinrig.rendering.camera`.
    lights
        At least one light; their radiance is summed.
    subsurface
        "local": R_d F_t F_t / pi; "dipole": subsurface scattering; "none": specular only.
    subpixels
        Camera rays along each side of a pixel.
    shadow_samples
        Shadow rays per camera ray to the disc of each light; 1 for lights without radius.
    blockers
        Mesh that casts shadows but is invisible.
    caster
        Precomputed shadow caster of the mesh.
    interior
        Precomputed interior of the model on the mesh, for "dipole".
    exchange
        Paths between parts of the skin, see `skinrig.rendering.transport`; None: direct light only.
    progress
        Called with one line per step.

    Returns
    -------
    Rendering

    Raises
    ------
    RenderingError
        If lights are missing, the mesh is not visible, or only its back is.
    """
    given = [lights] if isinstance(lights, Light) else lights
    return render_light_groups(
        surface,
        camera,
        [given],
        subsurface=subsurface,
        subpixels=subpixels,
        shadow_samples=shadow_samples,
        blockers=blockers,
        caster=caster,
        interior=interior,
        exchange=exchange,
        progress=progress,
    )[0]


def render_light_groups(
    surface: FittedSurface,
    camera: Camera,
    groups: Sequence[Sequence[Light]],
    *,
    subsurface: Subsurface = "local",
    subpixels: int = SUBPIXELS_PER_SIDE,
    shadow_samples: int = SHADOW_SAMPLES,
    blockers: Mesh | None = None,
    caster: Caster | None = None,
    interior: Interior | None = None,
    exchange: SkinExchange | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Rendering, ...]:
    """Render one image per group of lights; camera rays are traced once for all of them.

    Parameters
    ----------
    groups
        At least one group of at least one light; the radiance of a group is summed.
    surface, camera, subsurface, subpixels, shadow_samples, blockers, caster, interior, exchange, \
progress
        As for `render_surface`.

    Returns
    -------
    tuple of Rendering
        One per group, in their order.

    Raises
    ------
    RenderingError
        As for `render_surface`.
    """
    if not groups or not all(groups):
        raise RenderingError("lights: got none, expected at least one")
    require_choice("subsurface", subsurface, get_args(Subsurface), RenderingError)
    if shadow_samples < 1:
        raise RenderingError(
            f"shadow samples: got {shadow_samples}, expected 1 or more; enter another"
        )
    rays = Caster(surface.mesh) if caster is None else caster
    shadows = (
        rays
        if blockers is None
        else Caster(join_meshes(surface.mesh, blockers), choice=rays.choice)
    )
    shaders = []
    for group in groups:
        lamps = [part for light in group for part in light.parts()]
        lighting = Lighting(lamps, shadows, shadow_samples)
        returning = None if exchange is None else (exchange, exchange.trace(lighting))
        inside = _subsurface_radiance(surface, subsurface, lighting, interior, returning)
        shaders.append(_Shader(surface, lighting, inside, returning))
    columns, height = camera.image_size
    films = [_PixelAccumulator(height, columns) for _ in groups]
    out = met = 0
    band = max(1, BAND_RAYS // (columns * subpixels**2))
    for top in range(0, height, band):
        part = (top, min(top + band, height))
        buffers = trace(
            rays, *rendering_camera.generate_rays(camera, subpixels=subpixels, rows=part)
        )
        facing = np.einsum("hwk,hwk->hw", buffers.face_normal, buffers.to_camera) > 0.0
        index = np.flatnonzero(buffers.mask & facing)
        out, met = out + len(index), met + int(np.count_nonzero(buffers.mask))
        points = _Points.of(surface, buffers, index)
        for film, shader in zip(films, shaders, strict=True):
            film.put(part, subpixels, index, points, shader.shade(points))
        if progress is not None and part[1] < height:
            progress(f"render: {100 * part[1] // height} %")
    _require_outside(out, met - out, camera)
    return tuple(film.develop(subsurface) for film in films)


def join_meshes(*meshes: Mesh) -> Mesh:
    """Join meshes for shadow rays."""
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes[:-1])])
    return build_mesh(
        np.concatenate([mesh.vertices_mm for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Hit points of camera rays on the outside, n points."""

    position_mm: Float32Array
    face_normal: Float32Array
    view: Float32Array
    uv: Float32Array
    rows: SurfacePointSamples

    @staticmethod
    def of(surface: FittedSurface, buffers: GBuffer, index: NDArray[np.intp]) -> _Points:
        """Gather the selected rows of a G-buffer and sample the maps there."""

        def flat(image: Float32Array) -> Float32Array:
            return image.reshape(-1, image.shape[-1])[index]

        uv, position = flat(buffers.uv), flat(buffers.position_mm)
        rows = surface.at(uv, position, flat(buffers.normal))
        return _Points(position, flat(buffers.face_normal), flat(buffers.to_camera), uv, rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Shaded:
    """Radiance of n points towards the camera."""

    diffuse: Float64Array
    surface: Float64Array
    lit: BoolArray


def _require_outside(out: int, inside: int, camera: Camera) -> None:
    """Raise if the camera's rays miss the mesh, or mostly hit its inside."""
    place = ", ".join(f"{x:.0f}" for x in camera.center_mm)
    if out + inside == 0:
        raise RenderingError(
            f"view {camera.serial!r}: the camera at {place} mm has no view of the mesh; "
            "point it at the face, which is at the rig's origin and looks along +z"
        )
    if out < MIN_OUTSIDE_FRACTION * (out + inside):
        raise RenderingError(
            f"view {camera.serial!r}: the camera at {place} mm is behind the head and views "
            "the inside of the mesh; move it to the front, z > 0"
        )


class _PixelAccumulator:
    """Image buffers into which rays are averaged."""

    def __init__(self, height: int, width: int) -> None:
        self.diffuse, self.surface = (np.zeros((height, width, 3), np.float32) for _ in range(2))
        self.uv = np.zeros((height, width, 2), np.float32)
        self.coverage = np.zeros((height, width), np.float32)
        self.measured, self.lit = (np.zeros((height, width), np.bool_) for _ in range(2))

    def put(
        self,
        part: tuple[int, int],
        subpixels: int,
        index: NDArray[np.intp],
        points: _Points,
        shaded: _Shaded,
    ) -> None:
        """Average the rays of a band of pixel rows."""
        width, tall = self.coverage.shape[1], part[1] - part[0]
        wide = width * subpixels
        pixel = index // wide // subpixels * width + index % wide // subpixels
        count = np.bincount(pixel, minlength=tall * width).astype(np.float64)
        rows = slice(*part)

        def total(values: NDArray[np.generic]) -> Float64Array:
            sums = np.bincount(pixel, weights=values, minlength=tall * width)
            return np.asarray(sums, np.float64)

        for image, values in ((self.diffuse, shaded.diffuse), (self.surface, shaded.surface)):
            for channel in range(3):
                mean = total(values[:, channel]) / subpixels**2
                image[rows, :, channel] = mean.reshape(tall, width)
        for channel in range(2):
            mean = total(points.uv[:, channel]) / np.maximum(count, 1.0)
            self.uv[rows, :, channel] = mean.reshape(tall, width)
        self.coverage[rows] = (count / subpixels**2).reshape(tall, width)
        some = count > 0
        for mask, good in ((self.measured, points.rows.measured), (self.lit, shaded.lit)):
            mask[rows] = (some & (total(good) == count)).reshape(tall, width)

    def develop(self, subsurface: Subsurface) -> Rendering:
        """Return the image of all bands."""
        whole = self.coverage > 1.0 - 1e-6
        light = self.diffuse + self.surface, self.diffuse, self.surface
        masks = self.measured & whole, self.lit & whole
        return Rendering(*light, self.coverage, *masks, self.uv, subsurface)


Returning = tuple[SkinExchange, ReturningLight] | None
"""Paths between parts of the skin and the light on them; None: direct light only."""


def _subsurface_radiance(
    surface: FittedSurface,
    subsurface: Subsurface,
    lighting: Lighting,
    interior: Interior | None,
    returning: Returning,
) -> Callable[[_Points, Float64Array], Float64Array]:
    """Return the function from entering to exiting subsurface flux at points."""
    if subsurface == "none":
        return lambda points, entered: np.zeros_like(entered)
    if subsurface == "local":
        return lambda points, entered: entered * points.rows.r_d
    below = Interior.of(surface) if interior is None else interior
    light = below.compute_entered_flux(lighting)
    if returning is not None:
        exchange, from_skin = returning
        light += exchange.entered_at(from_skin, below.position_mm)
    return lambda points, entered: below.compute_exitant_flux(
        light, points.position_mm, points.rows, entered
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Shader:
    """Lights on a surface, with the light inside it and between its parts."""

    surface: FittedSurface
    lighting: Lighting
    inside: Callable[[_Points, Float64Array], Float64Array]
    returning: Returning

    def shade(self, points: _Points) -> _Shaded:
        """Compute the radiance of points towards the camera, summed over lights."""
        count = len(points.uv)
        entered, surface = np.zeros((count, 3)), np.zeros((count, 3))
        lit = np.zeros(count, np.bool_)
        rows = points.rows
        cos_view = np.einsum("nk,nk->n", rows.normals, points.view, dtype=np.float64)
        position, faces, normals = points.position_mm, points.face_normal, rows.normals
        for lamp in self.lighting.lamps:
            through, arriving, towards, seen = self.lighting.entering_radiance(
                lamp, position, faces, normals, self.surface.model.eta
            )
            entered += through
            lit |= seen >= MIN_LIT_FRACTION
            shown = np.flatnonzero((seen > 0.0) & (cos_view > 0.0))
            at = rows.weights[shown], towards[shown], points.view[shown], normals[shown]
            lobe = lobe_brdf(self.surface.model.lobes, *at)
            surface[shown] += np.pi * lobe[:, None] * arriving[shown]
        if self.returning is not None:
            exchange, from_skin = self.returning
            entered += exchange.entered_at(from_skin, position)
            surface += exchange.reflected_at(from_skin, position, faces, rows, points.view)
        leaving = transmittance(cos_view, self.surface.model.eta)[:, None]
        return _Shaded(leaving * self.inside(points, entered), surface, lit & (cos_view > 0.0))
