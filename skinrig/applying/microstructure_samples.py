"""Draw sphere, pushed patch and faces of Nagano et al. 2015 (figures 5, 14, 1, 15 and 16).

The sphere has noise in space (top row) and relief grown from a patch (bottom row); it is shrunk,
grown and squashed. The patch is a block of 25,392 tetrahedra that a probe pushes; its surface is
shaded with specular reflection and subsurface scattering by the dipole (`model.dipole`). Faces are
squares of a simulated head in expressions (`skinrig.applying.face_figures`).

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline, griddata

from model import fresnel, store
from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.volume_noise import VolumeNoise
from model.fresnel import ETA_SKIN
from model.microstructure import FOREHEAD, KernelTable
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.applying import microstructure_sphere as spheres
from skinrig.applying.expression import ApplyError
from skinrig.applying.face_figures import draw_faces
from skinrig.applying.microstructure import strain_image
from skinrig.applying.pushed_patch import BLOCK_DIVISIONS, Push, PushedPatch, SkinBlock, push_block
from skinrig.applying.relief import level_site_patch
from skinrig.applying.subsurface_grid import SKIN_COLOR, SKIN_PATH_MM, gather_subsurface
from skinrig.arrays import Float32Array, Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError, require_choice

SAMPLE_SCHEMA: Final = "skinrig.microstructure-sample/1"
SAMPLE_SIZES_PX: Final[Mapping[str, int]] = {"sphere": 2048, "patch": 1000, "face": 1200}
"""Side of the displacement maps: pixels of about 10 um; those of a face have 10 um at any size."""
SIZE_LIMITS_PX: Final = (64, 4096)
SIMULATED_SITE: Final = "forehead"
GROWN_PATCH_MM: Final[Mapping[str, float]] = {"sphere": 3.0, "patch": 3.0, "face": 6.0}
"""Side of the simulated patch; that of a face is grown over the largest area."""
NOISE_BAND_PER_MM: Final = (1.0, 25.0)
FACET_ROUGHNESS: Final = 0.25
"""GGX roughness of facets below the maps' pixels, 10 um."""
LIGHT_DIRECTION: Final = (-0.55, 0.45, 0.7)
VIEW_TILT_RAD: Final = 0.45
"""Angle of the view from the normal of the patch, towards -y."""
MIN_COSINE: Final = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class SampleRelief:
    """Relief of a site at equal pixels, with its table of kernels.

    Attributes
    ----------
    height_um
        Heights about zero, um, (H, W).
    pixel_um
        Side of a pixel, um.
    table
        Kernels over stretch.
    source
        Origin of both.
    """

    height_um: Float32Array
    pixel_um: float
    table: KernelTable
    source: str

    @staticmethod
    def simulated(seed: int, size_mm: float) -> SampleRelief:
        """Return simulated skin of the forehead with the paper's table."""
        skin = make_micro_skin(SIMULATED_SITE, seed=seed, size_mm=size_mm)
        source = f"simulated {SIMULATED_SITE}, the paper's table"
        return SampleRelief(skin.height_um, skin.texel_um, FOREHEAD, source)

    @staticmethod
    def fitted(path: Path, site: str | None = None) -> SampleRelief:
        """Return relief and table of a site of a fitted folder; None: its first site.

        Raises
        ------
        ApplyError, DynamicAppearanceError
            For a folder without this site.
        """
        appearance, found = dynamic_appearance.read(path, parts=(MICROSTRUCTURE,))
        sites = found.get(MICROSTRUCTURE, {}).get("sites", {})
        if not sites:
            raise ApplyError(f"{path}: lacks microstructure; use `skinrig fit microstructure`")
        name = next(iter(sites)) if site is None else site
        require_choice("--relief-site", name, sites, ApplyError)
        table = KernelTable.from_json(appearance.files[sites[name]["table"]].decode())
        patch = level_site_patch(name, appearance, sites[name])
        patch = np.where(np.isfinite(patch), patch, np.float32(0.0))
        return SampleRelief(patch, float(sites[name]["pixel_um"]), table, f"{path.name}, {name}")


def draw_sample(
    kind: str,
    out: Path,
    relief: SampleRelief,
    *,
    size_px: int | None = None,
    seed: int = 0,
    divisions: tuple[int, int, int] = BLOCK_DIVISIONS,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Deform a sample with its relief, and write figures, maps and ``sample.json``.

    Parameters
    ----------
    kind
        "sphere" (figure 5), "patch" (figure 14) or "face" (figures 1, 15 and 16).
    out
        Folder to write.
    relief
        Relief of the skin.
    size_px
        Side of the displacement map; None: that of `SAMPLE_SIZES_PX`.
    seed
        Seed of noise and growth.
    divisions
        Cells of the patch's block along x, y and z, six tetrahedra each.
    progress
        Called with one line per step.

    Returns
    -------
    dict
        JSON values: figures of the deformation, names of the files.

    Raises
    ------
    UnusableError
        For a size outside `SIZE_LIMITS_PX`.
    skinrig.errors.MissingExtra
        For a patch without scikit-fem.
    """
    side = SAMPLE_SIZES_PX[kind] if size_px is None else size_px
    low, high = SIZE_LIMITS_PX
    if not low <= side <= high:
        raise UnusableError(f"--size-px: got {side}, expected {low} to {high} pixels; change it")
    rng = np.random.default_rng(seed)
    if kind == "sphere":
        drawn, maps, found = _draw_sphere(relief, side, rng, progress)
    elif kind == "patch":
        drawn, maps, found = _draw_patch(relief, side, rng, divisions, progress)
    else:
        drawn, maps, views = draw_faces(
            relief.height_um,
            patch_pixel_um=relief.pixel_um,
            table=relief.table,
            texels=side,
            seed=seed,
            progress=progress,
        )
        found = {"of": views}
    out.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        write_atomically(out / name, figure)
    for file, image in maps.items():
        part = out / f".{file}.part.exr"
        store.write_exr(part, image)
        part.replace(out / f"{file}.exr")
    document = {
        "schema": SAMPLE_SCHEMA,
        "sample": kind,
        "relief": relief.source,
        "seed": seed,
        "size_px": side,
        **found,
        "files": [*drawn, *(f"{file}.exr" for file in maps)],
        "strain_channels": "r_s, r_t, angle of s from +x towards +y, rad",
    }
    write_atomically(out / "sample.json", json.dumps(document, indent=1))
    return document


def _draw_sphere(
    relief: SampleRelief, side: int, rng: np.random.Generator, progress: Callable[[str], None]
) -> tuple[dict[str, bytes], dict[str, Float32Array], dict[str, Any]]:
    """Return figure 5, maps of the squashed sphere, and variances of slopes by shape."""
    sphere = spheres.Sphere(texels=side)
    rms_um = float(np.std(relief.height_um))
    finest = 0.4e3 / float(np.median(sphere.pixel_um()))
    band = (NOISE_BAND_PER_MM[0], max(1.5, min(NOISE_BAND_PER_MM[1], finest)))
    progress(f"relief of {side} x {side} pixels")
    noise = sphere.sample_noise_relief(VolumeNoise.draw(rms_um=rms_um, band_per_mm=band, rng=rng))
    grown = sphere.grow_relief([relief.height_um], patch_pixel_um=relief.pixel_um, rng=rng)
    noise *= np.float32(np.std(np.diff(grown)) / np.std(np.diff(noise)))  # equally steep
    rows: list[tuple[str, str, spheres.DeformedSphere]] = []
    for kind, height, names in (
        ("noise", noise, ("shrunk", "neutral", "grown")),
        ("patch", grown, ("neutral", "squashed", "squashed, static")),
    ):
        for name in names:
            progress(f"{kind}, {name}")
            ratios = spheres.DEFORMATION_RATIOS[name.partition(",")[0]]
            dynamic = "static" not in name
            made = spheres.deform(sphere, height, ratios, table=relief.table, dynamic=dynamic)
            rows.append((kind, name, made))
    figure, axes = new_figure(9.0, 6.2, 2, 3)
    images = [made.render() for _, _, made in rows]
    white = float(np.percentile(np.concatenate([i[i > 0] for i in images]), 99.5))
    for axis, (kind, name, _), image in zip(axes.flat, rows, images, strict=True):
        axis.imshow(np.clip(image / white, 0.0, 1.0) ** (1.0 / 2.2), cmap="gray", vmin=0, vmax=1)
        axis.set_title(f"{kind}, {name}", fontsize=9)
        axis.axis("off")
    squashed = rows[4][2]
    maps = {
        "displacement_neutral": grown,
        "displacement": squashed.height_um,
        "strain": strain_image(squashed.strain),
    }
    shapes = [
        {"relief": kind, "shape": name, "slope_variances": list(made.roughness("front"))}
        for kind, name, made in rows
    ]
    drawn = {"figure-5.png": encode_figure(figure)}
    return drawn, maps, {"pixel_um": float(np.min(sphere.pixel_um())), "of": shapes}


def _draw_patch(
    relief: SampleRelief,
    side: int,
    rng: np.random.Generator,
    divisions: tuple[int, int, int],
    progress: Callable[[str], None],
) -> tuple[dict[str, bytes], dict[str, Float32Array], dict[str, Any]]:
    """Return figure 14, maps of the pushed patch, and figures of its equilibrium."""
    block = SkinBlock(divisions=divisions)
    pixel_um = 1e3 * block.width_mm / side
    progress(f"relief of {side} x {side} pixels of {pixel_um:.1f} um")
    neutral = displacement_synthesis.grow(
        [relief.height_um], side, rng=rng, pixel_um=pixel_um, patch_pixel_um=relief.pixel_um
    )
    progress(f"equilibrium of {6 * int(np.prod(divisions))} tetrahedra")
    pushed = push_block(block, Push())
    progress("strain and convolution")
    moved, field = pushed.convolve(neutral, table=relief.table)
    rest = replace(pushed, deformed_mm=pushed.rest_mm)
    shown = (("neutral", rest, neutral), ("pushed, static", pushed, neutral))
    figure, axes = new_figure(10.5, 4.0, 1, 3)
    images = []
    for name, patch, height in (*shown, ("pushed, dynamic", pushed, moved)):
        progress(f"image: {name}")
        images.append((name, shade_patch(patch, height)))
    white = float(np.nanpercentile(images[0][1], 99.7))
    for axis, (name, image) in zip(axes.flat, images, strict=True):
        level = np.clip(np.nan_to_num(image) / white, 0.0, 1.0) ** (1.0 / 2.2)
        axis.imshow(level)
        axis.set_title(name, fontsize=9)
        axis.axis("off")
    maps = {"displacement_neutral": neutral, "displacement": moved, "strain": strain_image(field)}
    figures = {
        "pixel_um": pixel_um,
        "tetrahedra": len(pushed.tetrahedra),
        "iterations": pushed.outcome.iterations,
        "volume_ratio": pushed.volume_ratio,
        "stretch": [float(field.stretch.min()), float(field.stretch.max())],
        "r_d": list(SKIN_COLOR),
        "mean_free_path_mm": list(SKIN_PATH_MM),
        "rms_um": [float(np.std(neutral)), float(np.std(moved))],
    }
    return {"figure-14.png": encode_figure(figure)}, maps, figures


def shade_patch(patch: PushedPatch, height_um: Float32Array) -> Float64Array:
    """Render a patch with specular reflection and subsurface scattering.

    Parameters
    ----------
    patch
        Its coarse surface.
    height_um
        Displacement along the surface's normal, um, (N, N), row 0 at +y.

    Returns
    -------
    ndarray, shape (N, N, 3)
        Radiance of a distant light of irradiance pi, seen from afar; NaN outside the patch. Shadows
        and light between parts of the relief are left out.
    """
    points, normals, area = _surface(patch, height_um)
    light = np.asarray(LIGHT_DIRECTION) / np.linalg.norm(LIGHT_DIRECTION)
    view = np.array([0.0, -np.sin(VIEW_TILT_RAD), np.cos(VIEW_TILT_RAD)])
    to_light = np.clip(normals @ light, 0.0, 1.0)
    to_view = np.clip(normals @ view, MIN_COSINE, 1.0)
    entered = np.pi * to_light * (1.0 - fresnel.reflectance(to_light, ETA_SKIN))
    leaves = gather_subsurface(points, area, entered) / np.pi
    leaves *= (1.0 - fresnel.reflectance(to_view, ETA_SKIN))[..., None]
    half = (light + view) / np.linalg.norm(light + view)
    square = FACET_ROUGHNESS**2
    cosine = np.clip(normals @ half, 0.0, 1.0)
    facets = square / (np.pi * (cosine**2 * (square - 1.0) + 1.0) ** 2)
    mirror = float(fresnel.reflectance(np.asarray(half @ view), ETA_SKIN))
    specular = np.where(to_light > 0, np.pi * facets * mirror / (4.0 * to_view), 0.0)
    return _project(points, leaves + specular[..., None], view)


def _surface(
    patch: PushedPatch, height_um: Float32Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return points, mm, unit normals and areas, mm^2, of the pixels of a displaced surface."""
    side = height_um.shape[0]
    nodes = np.unique(patch.surface)
    order = nodes[np.lexsort((patch.rest_mm[nodes, 0], patch.rest_mm[nodes, 1]))]
    lines = round(len(order) ** 0.5)
    grid = np.linspace(-0.5, 0.5, lines) * patch.width_mm
    x = ((np.arange(side) + 0.5) / side - 0.5) * patch.width_mm
    coarse = np.stack(
        [
            RectBivariateSpline(grid, grid, patch.deformed_mm[order, k].reshape(lines, lines))(
                x, x
            )[::-1]
            for k in range(3)
        ],
        axis=-1,
    )
    outward = _unit(_normal(coarse))
    points = coarse + 1e-3 * np.asarray(height_um, np.float64)[..., None] * outward
    across = _normal(points)
    area = np.linalg.norm(across, axis=-1)
    return points, across / area[..., None], area


def _normal(points: Float64Array) -> Float64Array:
    """Return the cross product of the steps to the right and up, per pixel."""
    down, right = np.gradient(points, axis=(0, 1))
    return np.cross(right, -down)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _project(points: Float64Array, radiance: Float64Array, view: Float64Array) -> Float64Array:
    """Return the image of a surface from a direction, orthographic; NaN outside the surface."""
    side = points.shape[0]
    up = np.cross(view, [1.0, 0.0, 0.0])
    step = max(1, side // 200)
    rows, columns = np.meshgrid(*2 * [np.arange(0, side, step)], indexing="ij")
    flat = ndimage.gaussian_filter(points, (step, step, 0))[::step, ::step].reshape(-1, 3)
    screen = np.stack([flat[:, 0], flat @ up], axis=1)
    half = 0.5 * (points[..., 0].max() - points[..., 0].min())
    line = ((np.arange(side) + 0.5) / side * 2.0 - 1.0) * half
    x, y = np.meshgrid(line, -line)
    texel = griddata(screen, np.stack([rows.ravel(), columns.ravel()], 1).astype(float), (x, y))
    inside = np.isfinite(texel).all(axis=-1)
    image = np.full((side, side, 3), np.nan)
    for k in range(3):
        at = np.moveaxis(texel[inside], 1, 0)
        image[inside, k] = ndimage.map_coordinates(radiance[..., k], at, order=1, mode="nearest")
    return image
