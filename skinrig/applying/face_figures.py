"""Draw the faces of Nagano et al. 2015 (figures 1, 15 and 16) on simulated skin.

Each figure has a square of a face in an expression: photographs of the neutral skin, of the
strained skin without relief, with static and with dynamic microstructure; their specular reflection
with its change; and close-ups with simulated skin in equilibrium as the reference.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from model.microstructure import KernelTable
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.applying.face_photograph import FlashCamera, Photograph, develop, photograph
from skinrig.applying.microstructure import strain_image
from skinrig.applying.strained_closeup import CloseUp, PlaneStrain, photograph_closeup
from skinrig.applying.strained_face import FACE_VIEWS, FaceView, crop_face
from skinrig.arrays import Float32Array, Float64Array

TEXEL_MM: Final = 0.01
"""Side of the texels on the skin at rest, as of the paper."""
FIELD_SHARE: Final = 0.6
"""Width of the photographs over the side of the squares, which tilt and compression shorten."""
TEXELS_PER_PIXEL: Final = 2.0
CLOSEUP_MM: Final = 4.0
CLOSEUP_FIELD_MM: Final = 2.4
CLOSEUP_PX: Final = 320
CLOSEUP_SITE: Final = "forehead"
FIGURE_DPI: Final = 110
WHITE_PERCENTILE: Final = 99.7
SKIN_LEVEL: Final = 0.4
"""Linear level of the median skin in photographs; white is 1."""

Maps = dict[str, Float32Array]


@dataclass(frozen=True, slots=True, eq=False)
class StrainedFace:
    """Maps and photographs of one view.

    Attributes
    ----------
    neutral_um, moved_um
        Relief at rest and under strain, (N, N), um.
    strain
        r_s, r_t and angle per texel, (N, N, 3).
    images
        Photographs: "neutral", "no relief", "static" and "dynamic".
    middle
        Strain at the middle of the square.
    figures
        JSON values of the view.
    """

    neutral_um: Float32Array
    moved_um: Float32Array
    strain: Float32Array
    images: Mapping[str, Photograph]
    middle: PlaneStrain
    figures: dict[str, Any]


def strain_face(
    view: FaceView,
    patch_um: Float32Array,
    *,
    patch_pixel_um: float,
    table: KernelTable,
    texels: int,
    seed: int,
    camera: FlashCamera,
) -> StrainedFace:
    """Grow relief over a square of a face, strain both, and photograph them.

    Parameters
    ----------
    view
        Place and expression.
    patch_um, patch_pixel_um
        Relief about zero, (H, W), um, and the side of its pixels, um.
    table
        Kernels over stretch.
    texels
        Texels of `TEXEL_MM` along each side of the square.
    seed
        Seed of the growth.
    camera
        Camera and light, aimed at the middle of the square in either state.
    """
    crop = crop_face(view, side_mm=TEXEL_MM * texels, texels=texels)
    rng = np.random.default_rng(seed)
    neutral = crop.grow_relief(patch_um, patch_pixel_um=patch_pixel_um, rng=rng)
    moved, field = crop.convolve(neutral, table=table)
    images = {
        "neutral": photograph(crop.rest_mm, neutral, camera),
        "no relief": photograph(crop.deformed_mm, np.zeros_like(neutral), camera),
        "static": photograph(crop.deformed_mm, neutral, camera),
        "dynamic": photograph(crop.deformed_mm, moved, camera),
    }
    figures = {
        "view": view.name,
        "pixel_um": float(np.median(crop.pixel_um)),
        "stretch_s": _range(field.stretch[..., 0]),
        "stretch_t": _range(field.stretch[..., 1]),
        "slope_variances": {
            "neutral": list(crop.slope_variances(neutral, field, deformed=False)),
            "static": list(crop.slope_variances(neutral, field)),
            "dynamic": list(crop.slope_variances(moved, field)),
        },
        "specular_contrast": {name: one.specular_contrast for name, one in images.items()},
        "highlight_change": _change(images["static"], images["dynamic"]),
    }
    return StrainedFace(neutral, moved, strain_image(field), images, PlaneStrain.of(field), figures)


def draw_faces(
    patch_um: Float32Array,
    *,
    patch_pixel_um: float,
    table: KernelTable,
    texels: int,
    seed: int,
    progress: Callable[[str], None],
) -> tuple[dict[str, bytes], Maps, list[dict[str, Any]]]:
    """Draw all views; return PNG files, maps and figures by view.

    Parameters
    ----------
    patch_um, patch_pixel_um, table, texels, seed
        As of :func:`strain_face`.
    progress
        Called with one line per view.
    """
    pixels = max(16, round(FIELD_SHARE * texels / TEXELS_PER_PIXEL))
    camera = FlashCamera(field_mm=FIELD_SHARE * TEXEL_MM * texels, size_px=pixels)
    skin = make_micro_skin(CLOSEUP_SITE, seed=seed, size_mm=CLOSEUP_MM)
    files: dict[str, bytes] = {}
    maps: Maps = {}
    figures = []
    for name, view in FACE_VIEWS.items():
        progress(f"{view.name}: {texels} x {texels} texels, four photographs")
        made = strain_face(
            view,
            patch_um,
            patch_pixel_um=patch_pixel_um,
            table=table,
            texels=texels,
            seed=seed,
            camera=camera,
        )
        progress(f"{view.name}: equilibrium of a patch of {CLOSEUP_MM} mm")
        near = replace(camera, field_mm=CLOSEUP_FIELD_MM, size_px=CLOSEUP_PX)
        closeup = photograph_closeup(skin, made.middle, table=table, camera=near)
        files[f"{name}.png"] = _draw(made, closeup, camera, np.random.default_rng(seed))
        maps[f"{name}-displacement_neutral"] = made.neutral_um
        maps[f"{name}-displacement"] = made.moved_um
        maps[f"{name}-strain"] = made.strain
        figures.append({"figure": name, **made.figures, "closeup": closeup.figures})
    return files, maps, figures


def _draw(
    made: StrainedFace, closeup: CloseUp, camera: FlashCamera, rng: np.random.Generator
) -> bytes:
    """Return the PNG of one view: photographs, specular reflection, and close-ups below."""
    figure, axes = new_figure(15.0, 11.7, 3, 4)
    images = made.images
    white = float(np.nanmedian(images["neutral"].total)) / SKIN_LEVEL
    for axis, name in zip(axes[0], ("neutral", "no relief", "static", "dynamic"), strict=True):
        axis.imshow(develop(images[name].total, white, camera, rng), interpolation="none")
        axis.set_title(name)
    white = float(np.nanpercentile(images["neutral"].specular, WHITE_PERCENTILE))
    for axis, name in zip(axes[1, :3], ("neutral", "static", "dynamic"), strict=True):
        gray = develop(images[name].specular, white, camera, rng)
        axis.imshow(gray, cmap="gray", vmin=0.0, vmax=1.0, interpolation="none")
        axis.set_title(f"specular, {name}")
    change = images["dynamic"].specular - images["static"].specular
    axes[1, 3].imshow(change / white, cmap="RdBu_r", vmin=-0.25, vmax=0.25, interpolation="none")
    axes[1, 3].set_title("specular, dynamic less static")
    white = float(np.nanpercentile(closeup.images["neutral"].specular, WHITE_PERCENTILE))
    for axis, name in zip(axes[2], closeup.images, strict=True):
        gray = develop(closeup.images[name].specular, white, camera, rng)
        axis.imshow(gray, cmap="gray", vmin=0.0, vmax=1.0, interpolation="none")
        axis.set_title(f"close-up, {name}")
    for axis in axes.flat:
        axis.axis("off")
    return encode_figure(figure, dpi=FIGURE_DPI)


def _range(values: Float32Array) -> list[float]:
    return [float(values.min()), float(values.max())]


def _change(before: Photograph, after: Photograph) -> float:
    """Return the RMS change of the specular radiance over the mean before."""
    change: Float64Array = after.specular - before.specular
    return float(np.sqrt(np.nanmean(change**2)) / np.nanmean(before.specular))
