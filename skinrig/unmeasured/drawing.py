"""Draw a person's eyes and hair, which no rig measured, over a rendering of the skin.

Shapes and colors are those of the live page, `skinrig.viewer.assets.face_parts`; reflection is that
of its shaders for direct light. Rays on the skin and the parts decide what is in front.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from model.brdf import microfacet
from model.skin_reflectance import SkinReflectance
from rigsim.face_parts import eyelids
from rigsim.face_parts.eyelids import Eyelids
from rigsim.face_parts.hair import CURVE_POINTS, HAIR_KINDS, WIDTH_MM
from rigsim.geometry.atlas import texture_of_vertices
from rigsim.geometry.mesh import Mesh, build_mesh, grid_faces
from rigsim.render import Caster, trace, visibility
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.rendering.camera import Camera, generate_rays
from skinrig.rendering.lights import Light
from skinrig.rendering.render import join_meshes
from skinrig.unmeasured.person import FaceParts
from skinrig.viewer.assets.face_parts import describe_colors

GRID_ROWS: Final = 11
"""Rows of the grid between the margins of the lids."""
SHEET_MM: Final = 1.2
"""Depth of the conjunctiva behind the corners of an eye."""
JOIN_MM: Final = 3.0
"""Difference in depth below which the eyeball and the conjunctiva blend."""
LID_GAP_MM: Final = 0.35
"""Least distance of open lids from the sphere of the cornea's apex."""
IRIS_RADIUS_MM: Final = 6.1
PUPIL_FRACTION: Final = 0.35
"""Radius of the pupil over that of the iris."""
ETA_CORNEA: Final = 1.336
EYE_ROUGHNESS: Final = 0.08
SCLERA_ALBEDO: Final = (0.54, 0.495, 0.455)
FLESH_ALBEDO: Final = (0.46, 0.25, 0.21)
"""Linear sRGB of the page's sclera, and of its conjunctiva in the corners."""
HAIR_SHADOW_MM: Final = 2.5
"""Height above the skin from which hair is lit: other hair casts no shadow."""


@dataclass(frozen=True, slots=True, eq=False)
class PartsLayer:
    """Image of parts in front of the skin.

    Attributes
    ----------
    radiance : ndarray of float64, shape (L, H, W, 3)
        By light, relative to a white patch's; 0 outside the parts, averaged over each pixel.
    coverage : ndarray of float64, shape (H, W)
        Fraction of a pixel that eyes and hair cover, 0 to 1.
    hidden : ndarray of float64, shape (H, W)
        That of hair, which is in front of skin.
    """

    radiance: Float64Array
    coverage: Float64Array
    hidden: Float64Array

    def draw_over(
        self, radiance: FloatArray, coverage: FloatArray
    ) -> tuple[Float64Array, Float64Array]:
        """Return the images, (L, H, W, 3), and the coverage, (H, W), of skin with the parts."""
        shown = 1.0 - self.hidden
        covered = self.coverage + shown * coverage
        # the background is not visible next to an eye, where the rays of both images differ
        at_eye = self.coverage > self.hidden
        scale = 1.0 / np.where(at_eye, covered, np.maximum(covered, 1.0))
        both = self.radiance + shown[..., None] * radiance
        return both * scale[..., None], np.where(at_eye, 1.0, np.minimum(covered, 1.0))


def open_lids(vertices_mm: FloatArray, lids: Sequence[Eyelids], opening: float) -> Float64Array:
    """Return the vertices of a face, (V, 3), with open lids; skin stays out of the eyes.

    Parameters
    ----------
    vertices_mm
        With closed lids, moved by an expression or not.
    lids
        Lids on these vertices.
    opening
        0 (closed, vertices as given) to about 1; above 1: wider.
    """
    out = np.array(vertices_mm, np.float64)
    for one in lids if opening > 0.0 else ():
        away = out[one.vertices] + one.displacement_mm(opening) - one.center_mm
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away *= np.maximum((eyelids.APEX_MM + LID_GAP_MM) / length, 1.0)
        out[one.vertices] = one.center_mm + away
    return out


def paint_undercoat(model: SkinReflectance, mesh: Mesh, parts: FaceParts) -> SkinReflectance:
    """Return the reflectance of skin under hair: darker, without gloss; R_d in linear sRGB."""
    covered = texture_of_vertices(mesh, parts.hair.coverage.max(axis=1), model.valid.shape[0])
    shown = 1.0 - covered[..., None]
    below = np.array(describe_colors(parts.hair)["multiple_scattering"])
    r_d = shown * model.r_d + (1.0 - shown) * below
    return replace(model, r_d=r_d.astype(np.float32), weights=shown * model.weights)


@dataclass(frozen=True, slots=True, eq=False)
class PartsView:
    """Eyes and hair of a person, lights, and the camera at which the eyes look."""

    parts: FaceParts
    rest: Mesh
    """Skin with closed lids."""
    camera: Camera
    lights: Sequence[Light]

    def draw(
        self, skin: Mesh, shadows: Caster, kinds: Sequence[str], opening: float, subpixels: int
    ) -> PartsLayer:
        """Draw hair, and eyes between open lids.

        Parameters
        ----------
        skin
            Moved skin with open lids.
        shadows
            Its caster: skin alone casts shadows.
        kinds
            Drawn kinds of `rigsim.face_parts.hair.HAIR_KINDS`; a person may have none of them.
        opening
            Opening of the lids; 0: no eyes.
        subpixels
            Rays along each side of a pixel.
        """
        lids = self.parts.lids if opening > 0.0 else ()
        curves, normals, width_mm = self._place_hair(skin, kinds, opening)
        k, size = subpixels, np.array(self.camera.image_size)
        if not lids and not len(curves):
            none = np.zeros(size[::-1])
            return PartsLayer(np.zeros((len(self.lights), *none.shape, 3)), none, none)
        ribbons = _build_ribbons(curves, normals, width_mm, self.camera)
        meshes = [skin, *(_build_eye(skin, one) for one in lids), ribbons]
        at = self.camera.project(np.concatenate([one.vertices_mm for one in meshes[1:]]))
        left, top = np.clip(at.min(axis=0).astype(int), 0, size)
        right, bottom = np.clip(at.max(axis=0).astype(int) + 2, 0, size)
        rays = generate_rays(self.camera, subpixels=k, rows=(top, bottom))
        rays = rays[0][:, k * left : k * right], rays[1][:, k * left : k * right]
        found = trace(Caster(join_meshes(*meshes), choice=shadows.choice), *rays)
        ends = np.cumsum([len(one.faces) for one in meshes])
        owner = np.searchsorted(ends, found.prim, side="right")
        colors = {k: np.array(v) for k, v in describe_colors(self.parts.hair).items()}
        image = np.zeros((*owner.shape, 3 * len(self.lights) + 2), np.float32)
        for number in range(1, len(meshes)):
            here = owner == number
            at, way, share = found.position_mm[here], -found.to_camera[here], found.uv[here, 0]
            if number < len(meshes) - 1:
                center = lids[number - 1].center_mm
                gaze = _normalize(self.camera.center_mm - center)
                eye = _Eye.at(center, gaze, at, way, share, colors["iris"])
                lit, shade = self._light(at, eye.normal, shadows), eye.shade
            else:
                lit = self._light(at + HAIR_SHADOW_MM * found.normal[here], None, shadows)
                curve, cell = np.divmod(found.prim[here] - ends[-2], 2 * (CURVE_POINTS - 1))
                cell %= CURVE_POINTS - 1
                along = _normalize(curves[curve, cell + 1] - curves[curve, cell])
                is_lock = width_mm[curve] == WIDTH_MM["scalp"]
                tone = _shade_along(share, is_lock) * (0.75 + 0.5 * (0.618034 * curve % 1.0))
                fiber = _Fiber(along, way, found.normal[here], tone[:, None], colors)
                shade = fiber.shade
            image[here, :-2] = np.concatenate([seen * shade(to) for to, seen in lit], axis=1)
            image[here, -2:] = 1.0, float(number == len(meshes) - 1)
        cells = image.reshape(bottom - top, k, right - left, k, -1).mean(axis=(1, 3))
        full = np.zeros((*size[::-1], cells.shape[-1]))
        full[top:bottom, left:right] = cells
        radiance = full[..., :-2].reshape(*size[::-1], -1, 3)
        return PartsLayer(np.moveaxis(radiance, 2, 0), full[..., -2], full[..., -1])

    def _place_hair(
        self, skin: Mesh, kinds: Sequence[str], opening: float
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return curves on moved skin, normals at their roots, and widths at the roots, mm."""
        hair = self.parts.hair
        moved = skin.vertices_mm[hair.roots] - self.rest.vertices_mm[hair.roots]
        curves = hair.points_mm.astype(np.float64) + moved[:, None]
        brows, lashes, _ = hair.counts
        curves[brows : brows + lashes] += opening * hair.opening_mm
        kind = np.repeat(HAIR_KINDS, hair.counts)
        chosen = np.isin(kind, kinds)
        width = np.array([WIDTH_MM[one] for one in kind[chosen]])
        return curves[chosen], skin.normals[hair.roots[chosen]].astype(np.float64), width

    def _light(
        self, at: Float32Array, normal: Float64Array | None, shadows: Caster
    ) -> Iterator[tuple[Float64Array, Float64Array]]:
        """Yield the direction of each light and what arrives of it at points, (n, 3) each."""
        for lamp in self.lights:
            towards, white = lamp.directions_and_irradiance(at)
            facing = (towards if normal is None else normal).astype(np.float32)
            seen = visibility(shadows, at, facing, lamp.disc()[0])
            yield towards, white * seen[:, None]


def _build_eye(skin: Mesh, lids: Eyelids) -> Mesh:
    """Return what is visible between open lids: the sclera's sphere, joined to its corners."""
    upper, lower = (skin.vertices_mm[one].astype(np.float64) for one in (lids.upper, lids.lower))
    grid = lower + np.linspace(0.0, 1.0, GRID_ROWS)[:, None, None] * (upper - lower)
    first, last = upper[1], upper[-2]
    share = (upper[:, 0] - first[0]) / (last[0] - first[0])
    flat = np.sum((grid[..., :2] - lids.center_mm[:2]) ** 2, axis=-1)
    sphere = lids.center_mm[2] + np.sqrt(np.maximum(eyelids.SCLERA_RADIUS_MM**2 - flat, 0.0))
    sheet = first[2] + share * (last[2] - first[2]) - SHEET_MM
    blend = np.maximum(JOIN_MM - np.abs(sphere - sheet), 0.0) / JOIN_MM
    grid[1:-1, :, 2] = (np.maximum(sphere, sheet) + 0.25 * JOIN_MM * blend**2)[1:-1]
    uv = np.broadcast_to(np.clip(share, 0.0, 1.0)[:, None], (GRID_ROWS, len(share), 2))
    return build_mesh(grid.reshape(-1, 3), grid_faces(*grid.shape[:2]), uv.reshape(-1, 2))


def _build_ribbons(
    curves: Float64Array, normals: Float64Array, width_mm: Float64Array, camera: Camera
) -> Mesh:
    """Return ribbons along curves, (S, P, 3), that face the camera; u is 0 at the root."""
    part = np.linspace(0.0, 1.0, CURVE_POINTS)
    across = _normalize(np.cross(np.gradient(curves, axis=1), camera.center_mm - curves))
    half = 0.5 * width_mm[:, None] * (1.0 - 0.8 * part**2)
    sides = np.array([-1.0, 1.0])[:, None] * (half[..., None] * across)[:, :, None]
    vertices = (curves[:, :, None] + sides).reshape(-1, 3)
    each = 2 * CURVE_POINTS
    faces = grid_faces(CURVE_POINTS, 2) + each * np.arange(len(curves))[:, None, None]
    uv = np.tile(np.repeat(part, 2)[:, None], (len(curves), 2))
    return build_mesh(vertices, faces.reshape(-1, 3), uv, np.repeat(normals, each, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """Points on an eye, (n, 3) each, as seen along rays through the cornea to the iris."""

    normal: Float64Array
    """Of the tear film."""
    shading: Float64Array
    """Normal of the diffuse reflection."""
    albedo: Float64Array
    off_axis: Float64Array
    """Visible point of the iris from its center, across the gaze, mm; 0 on the sclera."""
    way: FloatArray

    @staticmethod
    def at(
        center_mm: Float64Array,
        gaze: Float64Array,
        at_mm: FloatArray,
        way: FloatArray,
        share: FloatArray,
        iris: Float64Array,
    ) -> "_Eye":
        """Follow rays along `way` to points of an eye's grid, `share` from corner to corner."""
        start = at_mm - center_mm - 20.0 * way
        cornea_mm = eyelids.CORNEA_CENTER_MM * gaze
        outer = start + _meet(start - cornea_mm, way, eyelids.CORNEA_RADIUS_MM) * way
        cornea = (outer @ gaze > eyelids.LIMBUS_MM)[:, None]
        ball = start + _meet(start, way, eyelids.SCLERA_RADIUS_MM) * way
        ball = np.where(np.isnan(ball), at_mm - center_mm, ball)
        point = np.where(cornea, outer, ball)
        normal = _normalize(point - np.where(cornea, cornea_mm, 0.0))
        cosine = -_dot(normal, way)
        bend = cosine / ETA_CORNEA - np.sqrt(1.0 - (1.0 - cosine**2) / ETA_CORNEA**2)
        bent = way / ETA_CORNEA + bend * normal
        deep = eyelids.APEX_MM - eyelids.CHAMBER_DEPTH_MM
        ahead = (point @ gaze)[:, None]
        off_axis = point + (deep - ahead) / np.minimum(bent @ gaze, -0.05)[:, None] * bent
        off_axis = np.where(cornea, off_axis - deep * gaze, 0.0)
        right = _normalize(np.cross([0.0, 1.0, 0.0], gaze))
        x, y = off_axis @ right, off_axis @ np.cross(gaze, right)
        reach, angle = np.hypot(x, y) / IRIS_RADIUS_MM, np.arctan2(y, x)
        fibers = 0.5 + 0.35 * np.sin(13.0 * angle + 3.0 * reach) * np.sin(5.0 * angle - 7.0 * reach)
        bright = (0.45 + 1.15 * fibers) * (1.0 - 0.72 * _smooth((reach - 0.76) / 0.21))
        bright *= _smooth((reach - PUPIL_FRACTION + 0.02) / 0.04)
        limbus = np.where(cornea, 1.0 - _smooth((ahead - eyelids.LIMBUS_MM) / 0.28), 1.0)
        off = np.linalg.norm(at_mm - center_mm, axis=1) - eyelids.SCLERA_RADIUS_MM
        off = np.where(cornea[:, 0], 0.0, 0.75 * _smooth((off - 0.4) / 1.8))
        corner = np.maximum(1.0 - _smooth(share / 0.11), 0.6 * _smooth((share - 0.9) / 0.1))
        flesh = np.maximum(off, corner)[:, None]
        sclera = (1.0 - flesh) * SCLERA_ALBEDO + flesh * FLESH_ALBEDO
        sclera = sclera * (0.44 + 0.56 * _smooth((eyelids.LIMBUS_MM - ahead + 0.1) / 0.85))
        albedo = (1.0 - limbus) * bright[:, None] * iris + limbus * sclera
        shading = _normalize((1.0 - limbus) * gaze + limbus * normal)
        return _Eye(normal, shading, albedo, off_axis, way)

    def shade(self, towards: Float64Array) -> Float64Array:
        """Return the radiance by light from a direction, relative to a white patch's, (n, 3)."""
        half = _normalize(towards - self.way)
        cosine = _dot(self.normal, towards)
        cosines = cosine, -_dot(self.normal, self.way), _dot(self.normal, half)
        film = microfacet.brdf(
            *cosines, _dot(half, towards), roughness=EYE_ROUGHNESS, eta=ETA_CORNEA
        )
        # the cornea gathers light on the far side of the iris
        gathered = 1.0 - _dot(self.off_axis, towards) / (2.0 * IRIS_RADIUS_MM)
        wrapped = np.clip((_dot(self.shading, towards) + 0.12) / 1.12, 0.0, 1.0)
        return gathered * wrapped * self.albedo + np.pi * film * np.maximum(cosine, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Fiber:
    """Points on hair, (n, 3) each; Marschner et al. 2003, see ``viewer/glsl/hair.glsl``."""

    along: Float64Array
    way: Float64Array
    normal: Float64Array
    """Of the skin at the root."""
    tone: Float64Array
    """Light that other hair leaves."""
    colors: dict[str, Float64Array]

    def shade(self, towards: Float64Array) -> Float64Array:
        """Return the radiance by light from a direction, relative to a white patch's, (n, 3)."""
        sin_i, sin_r = _dot(self.along, towards), -_dot(self.along, self.way)
        cos_i = np.sqrt(np.maximum(1.0 - sin_i**2, 0.0))
        cos_phi = _dot(
            _normalize(towards - sin_i * self.along), _normalize(-self.way - sin_r * self.along)
        )
        inside = np.exp(-1.6 * self.colors["absorption"] / np.maximum(cos_i, 0.3))
        base = 1.0 - np.sqrt(np.clip(0.5 - 0.5 * _dot(towards, self.way), 0.0, 1.0))
        fresnel = 0.046 + 0.954 * base**5
        total = sin_i + sin_r
        once = 0.25 * np.sqrt(np.clip(0.5 + 0.5 * cos_phi, 0.0, 1.0)) * fresnel
        through = 0.9 * np.exp(-3.65 * cos_phi - 3.98) * inside
        twice = 3.6 * np.exp(17.0 * cos_phi - 16.78) * fresnel * inside**2
        direct = once * _lobe(total + 0.12, 0.16) + through * _lobe(total - 0.06, 0.08)
        direct = direct + twice * _lobe(total - 0.18, 0.3)
        diffuse = self.colors["multiple_scattering"] + 0.15 * inside**3
        facing = np.clip((_dot(self.normal, towards) + 0.35) / 1.35, 0.0, 1.0)
        return facing * self.tone * cos_i * (np.pi * direct + diffuse)


def _shade_along(part: FloatArray, is_lock: BoolArray) -> Float64Array:
    """Return the light that other hair leaves from the root, 0, to the tip, 1, of hair."""
    return np.where(is_lock, 0.25 + 0.75 * _smooth(part / 0.8), 0.55)


def _dot(a: FloatArray, b: FloatArray) -> Float64Array:
    return np.asarray(np.einsum("...k,...k->...", a, b)[..., None], np.float64)


def _lobe(x: Float64Array, width: float) -> Float64Array:
    return np.exp(-0.5 * (x / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)


def _meet(start: Float64Array, way: FloatArray, radius: float) -> Float64Array:
    """Return the distance, (n, 1), at which rays enter a sphere at 0; NaN for rays that miss it."""
    along = _dot(start, way)
    rest = along**2 - _dot(start, start) + radius**2
    return -along - np.sqrt(np.where(rest > 0.0, rest, np.nan))


def _normalize(vectors: FloatArray) -> Float64Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9), np.float64)


def _smooth(t: FloatArray) -> Float64Array:
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), np.float64)
