"""Evaluate a fitted model against photographs under held-out lights and views."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model import fresnel, store
from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance, assemble
from rigsim.geometry.atlas import sample, unwrap
from rigsim.geometry.mesh import Mesh
from rigsim.render import Caster
from skinrig.arrays import Float32Array
from skinrig.drawing import png
from skinrig.evaluating.skin_bands import classify_typology, typology_angle_deg
from skinrig.rendering import folder
from skinrig.rendering.folder import Panel, apply_tone_curve, choose_exposure, encode_sheet
from skinrig.rendering.geometry import FittedSurface, read_own_mesh
from skinrig.rendering.interior import Interior
from skinrig.rendering.photographs.errors import (
    Comparison,
    PairErrors,
    Photograph,
    compare_pair,
    group_errors_by_band,
    summarize_pairs,
)
from skinrig.rendering.photographs.held_out import HeldOutPhotographs, HeldOutShot
from skinrig.rendering.render import Rendering, Subsurface, render_surface
from skinrig.rendering.request import read_model
from skinrig.rendering.transport import PATH_SAMPLES, SkinExchange, Transport

N_DRAWN_IMAGES: Final = 6
"""Number of photographs drawn with their renderings, at equal steps."""
DIRECT_LIGHT: Final = "direct light only"
"""Rendering without light that skin reflects onto skin."""
MAX_SHOWN_ERROR: Final = 0.2
"""Relative error at the end of the images' color scale."""


@dataclass(frozen=True, slots=True)
class EvaluationSettings:
    """Settings of the comparison."""

    subsurface: Subsurface = "dipole"
    """Treatment of subsurface light in the full model."""
    transport: Transport = "direct"
    """"path": the full model includes light that skin reflects onto skin."""
    path_samples: int = PATH_SAMPLES
    """Directions of paths per element of the skin, for "path"."""
    count: int | None = None
    """Number of photographs, selected at equal steps; None: all."""
    ablation: bool = True
    """Whether the model is also rendered without each of its parts."""
    seed: int = 0
    """Random seed of the bootstrap intervals."""
    progress: Callable[[str], None] = field(default=lambda _: None)


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A model on its mesh, with precomputed data of all its images."""

    surface: FittedSurface
    caster: Caster
    interior: Interior | None
    photographs: HeldOutPhotographs
    exchange: SkinExchange | None = None

    def render(
        self, shot: HeldOutShot, subsurface: Subsurface, *, direct: bool = False
    ) -> Rendering:
        shown = self.photographs.camera(shot), self.photographs.light(shot)
        return render_surface(
            self.surface,
            *shown,
            subsurface=subsurface,
            caster=self.caster,
            interior=self.interior,
            exchange=None if direct else self.exchange,
        )

    def render_ablations(
        self, made: Rendering, shot: HeldOutShot, fewer: Mapping[str, _Surface]
    ) -> Iterator[tuple[str, Float32Array]]:
        """Yield the renderings with a part removed, from that of the full model."""
        yield "without the surface", made.diffuse
        yield "without light from inside", made.surface
        if self.exchange is not None:
            yield DIRECT_LIGHT, self.render(shot, made.subsurface, direct=True).radiance
        if made.subsurface == "dipole":
            yield "light that does not spread", self.render(shot, "local").radiance
        for name, less in fewer.items():
            if name == "one lobe":  # the diffuse component is unchanged
                yield name, made.diffuse + less.render(shot, "none").surface
            else:
                yield name, less.render(shot, made.subsurface).radiance


def evaluate_photographs(
    appearance: SkinAppearance,
    photographs: HeldOutPhotographs,
    settings: EvaluationSettings,
    *,
    truth: SkinAppearance | None = None,
    model: SkinReflectance | None = None,
) -> tuple[Comparison, dict[str, bytes]]:
    """Render the views and lights of photographs, and compare.

    Parameters
    ----------
    appearance
        Fitted appearance with its mesh.
    photographs
        Photographs that were held out of the fit.
    settings
        Subsurface light, number of photographs, ablation.
    truth
        Ground truth of a simulated face; used only for bands of skin color.
    model
        Model to render in place of the appearance's own; None: its own.

    Returns
    -------
    comparison : Comparison
    pictures : dict of str to bytes
        PNG files by name: photograph, rendering and relative error side by side.

    Raises
    ------
    RenderingError, GeometryError, SkinReflectanceError
        If photographs or a part of the model are missing.
    """
    begun = time.perf_counter()
    rng = np.random.default_rng(settings.seed)
    whole = assemble(appearance) if model is None else model
    mesh = read_own_mesh(appearance)
    laid = FittedSurface.of(whole, mesh)
    below = (
        Caster(mesh),
        Interior.of(laid) if settings.subsurface == "dipole" else None,
        photographs,
    )
    paths = {"samples": settings.path_samples, "seed": settings.seed}

    def lay(model: FittedSurface) -> _Surface:
        exchange = SkinExchange.for_transport(settings.transport, model, below[0], **paths)
        return _Surface(model, *below, exchange)

    surface = lay(laid)
    fewer = {
        name: lay(FittedSurface.of(less, mesh))
        for name, less in (build_ablations(whole, mesh) if settings.ablation else {}).items()
    }
    chosen = photographs.select_shots(settings.count)
    drawn = {
        chosen[int(k)] for k in np.linspace(0, len(chosen) - 1, min(N_DRAWN_IMAGES, len(chosen)))
    }
    pairs: list[PairErrors] = []
    bands: list[NDArray[np.str_]] = []
    parts: dict[str, list[PairErrors]] = {}
    kinds: dict[str, list[PairErrors]] = {}
    pictures: dict[str, bytes] = {}
    rows: list[dict[str, Any]] = []
    for number, shot in enumerate(chosen):
        settings.progress(f"{number + 1}/{len(chosen)} {shot.view} {shot.light}")
        photo = photographs.photograph(shot)
        made = surface.render(shot, settings.subsurface)
        pair = _compare(photo, made, made.radiance)
        pairs.append(pair)
        if pair.lit.any():
            kinds.setdefault(shot.held_out, []).append(pair)
        bands.append(_bands(whole, made))
        figures = {
            name: getattr(pair, name)
            for name in ("median", "noise", "ssim", "delta_e", "total_error")
        }
        lit = int(np.count_nonzero(pair.lit))
        rows.append({**dataclasses.asdict(shot), **figures, "lit_pixels": lit})
        for name, image in surface.render_ablations(made, shot, fewer) if settings.ablation else ():
            parts.setdefault(name, []).append(_compare(photo, made, image))
        if shot in drawn:
            pictures[f"{shot.view}-{shot.light}"] = _sheet(photo, made, pair, shot)
    angle, of = _typology_angle_deg(whole, truth)
    comparison = Comparison(
        subject=photographs.subject,
        full=summarize_pairs(pairs, rng=rng),
        by_kind={kind: summarize_pairs(some, rng=rng) for kind, some in kinds.items()},
        ablation={name: summarize_pairs(some, rng=rng) for name, some in parts.items()},
        by_band=group_errors_by_band(pairs, bands),
        typology_angle_deg=angle,
        typology_of=of,
        shots=tuple(rows),
        assumed=(*photographs.assumed, *whole.assumed),
        subsurface=settings.subsurface,
        seconds=time.perf_counter() - begun,
    )
    return comparison, pictures


def evaluate_folders(
    appearance: Path,
    session: Path,
    out: Path,
    settings: EvaluationSettings,
    *,
    calibration: Path | None = None,
    translucency: str | None = None,
) -> dict[str, Any]:
    """Compare an APPEARANCE/ with a SESSION/ and write images and record to ``out``.

    The ground truth is the folder that the appearance names, if it is next to it.

    Returns
    -------
    dict
        The record, see `skinrig.rendering.folder`.
    """
    folder.check(out)
    read, model = read_model(appearance, translucency=translucency)
    photographs = HeldOutPhotographs.of(session, read, calibration=calibration)
    named = str(read.parameters.get("truth", "") or "")
    truth_folder = appearance.resolve().parent / named
    found = (
        store.read(truth_folder)
        if named and (truth_folder / store.DOCUMENT_FILE).is_file()
        else None
    )
    comparison, pictures = evaluate_photographs(
        read, photographs, settings, truth=found, model=model
    )
    document = {
        "kind": "comparison with photographs",
        "appearance": appearance,
        "session": session,
        "inputs": {"session": dict(read.inputs).get("session"), "compared": str(session)},
        **comparison.document(),
    }
    return folder.write(out, images={}, pictures=pictures, document=document)


def _compare(photo: Photograph, made: Rendering, image: Float32Array) -> PairErrors:
    return compare_pair(photo, image, covered=made.covered, lit=made.lit)


def _bands(model: SkinReflectance, made: Rendering) -> NDArray[np.str_]:
    """Return the band of skin color of each pixel, "" outside measured skin."""
    height, width = made.covered.shape
    r_d = sample(np.asarray(model.r_d), made.uv.reshape(-1, 2), made.covered.reshape(-1))
    angle = typology_angle_deg(r_d * normal_reflectance_ratio(model.eta)).reshape(height, width)
    return np.where(made.covered, classify_typology(angle), "")


def normal_reflectance_ratio(eta: float) -> float:
    """Return diffuse reflectance at normal incidence over R_d: light crosses the boundary twice.

    Examples
    --------
    >>> round(1.0 / normal_reflectance_ratio(1.4), 3)
    1.114
    """
    return (1.0 - fresnel.normal_reflectance(eta)) * (1.0 - fresnel.diffuse_external(eta))


def _typology_angle_deg(model: SkinReflectance, truth: SkinAppearance | None) -> tuple[float, str]:
    if truth is not None and "reflectance" in truth.maps:
        known = truth.maps["reflectance"]
        return float(np.median(typology_angle_deg(known.values[known.mask]))), "truth"
    skin = model.r_d[model.valid] * normal_reflectance_ratio(model.eta)
    return float(np.median(typology_angle_deg(skin))), "r_d"


def _sheet(photo: Photograph, made: Rendering, pair: PairErrors, shot: HeldOutShot) -> bytes:
    exposure = choose_exposure(np.where(made.covered[..., None], photo.rgb, 0.0), made.coverage)
    on = made.coverage[..., None] > 0.5
    shown = [
        apply_tone_curve(np.where(on, image, 0.0), exposure) for image in (photo.rgb, made.radiance)
    ]
    scale = png.Scale(-MAX_SHOWN_ERROR, MAX_SHOWN_ERROR, "RdBu_r")
    error = scale.colors(pair.signed, pair.lit)
    panels = [
        Panel("photograph", shown[0]),
        Panel("rendering", shown[1]),
        Panel(f"error, red +{100 * MAX_SHOWN_ERROR:.0f} %", error),
    ]
    held_out = f"{shot.view} {shot.light} ({shot.held_out} held out)"
    return encode_sheet([panels], title=f"{held_out}: median {100 * pair.median:.1f} %")


def build_ablations(model: SkinReflectance, mesh: Mesh) -> Mapping[str, SkinReflectance]:
    """Build the ablated models, keyed by the replacement of a part.

    Parameters
    ----------
    model
        The full model.
    mesh
        Its mesh, with normals of the scan.

    Returns
    -------
    mapping
        "one lobe": the face's mean mixture of basis BRDFs, scaled per texel; "scanned normals":
        those of the mesh; "even albedo": the face's mean R_d.
    """
    flat = unwrap(mesh, model.valid.shape[0]).normal
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    normals = np.where(length > 0.5, flat / np.maximum(length, 1e-9), model.normals)
    mean = model.r_d[model.valid].mean(axis=0, dtype=np.float64)
    return {
        "one lobe": dataclasses.replace(model, weights=fit_one_lobe(model)),
        "scanned normals": dataclasses.replace(model, normals=normals.astype(np.float32)),
        "even albedo": dataclasses.replace(
            model, r_d=np.broadcast_to(mean, model.r_d.shape).astype(np.float32), r_d_stderr=None
        ),
    }


def fit_one_lobe(model: SkinReflectance) -> Float32Array:
    """Fit one common mixture of basis BRDFs, scaled per texel.

    Returns
    -------
    ndarray of float32, shape (H, W, K)
        Weights of least squares over the grid of the BRDFs, weighted by solid angle.
    """
    strength = model.lobes.strength()
    gram = model.lobes.cosine_similarity() * np.outer(strength, strength)
    shares = model.weights.astype(np.float64)
    common = shares[model.valid].mean(axis=0)
    size = float(common @ gram @ common)
    scale = shares @ gram @ common / size if size > 0 else np.zeros(shares.shape[:2])
    return (scale[..., None] * common).astype(np.float32)
