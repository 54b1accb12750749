"""Renderings of a fitted model against photographs under lights and views that it has not seen."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model import fresnel, store
from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance, assemble
from rigsim.geometry.atlas import sample
from rigsim.render import Caster
from skinrig.arrays import Float32Array
from skinrig.drawing import png
from skinrig.evaluating.skin_bands import bands_of, typology_angle_deg
from skinrig.rendering import folder
from skinrig.rendering.geometry import FittedSurface, own_mesh
from skinrig.rendering.images import Panel, exposure_of, sheet, tone
from skinrig.rendering.interior import Interior
from skinrig.rendering.photographs import errors as photograph_errors
from skinrig.rendering.photographs.ablation import without_parts
from skinrig.rendering.photographs.comparison import Comparison
from skinrig.rendering.photographs.errors import PairError, Photograph, Summary
from skinrig.rendering.photographs.held_out import Photographs, Shot
from skinrig.rendering.render import Rendering, Subsurface, render
from skinrig.rendering.request import read_model

N_PICTURES: Final = 6
"""Photographs that are drawn beside their renderings, even over all."""
MAX_SHOWN_ERROR: Final = 0.2
"""Relative error at the end of the pictures' scale."""

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A model laid on its mesh, with what is the same for all of its pictures."""

    laid: FittedSurface
    caster: Caster
    interior: Interior | None

    def render(self, photographs: Photographs, shot: Shot, subsurface: Subsurface) -> Rendering:
        shown = photographs.camera(shot), photographs.light(shot)
        below = self.interior
        return render(self.laid, *shown, subsurface=subsurface, caster=self.caster, interior=below)


def evaluate(
    appearance: SkinAppearance,
    photographs: Photographs,
    *,
    truth: SkinAppearance | None = None,
    subsurface: Subsurface = "dipole",
    count: int | None = None,
    ablation: bool = True,
    model: SkinReflectance | None = None,
    rng: np.random.Generator,
    progress: Tell | None = None,
) -> tuple[Comparison, dict[str, bytes]]:
    """Render what the photographs show, and compare.

    Parameters
    ----------
    appearance
        Fitted, with its mesh.
    photographs
        Those it was not fitted to.
    truth
        Of the face, where it is simulated; tells its skin color only.
    subsurface
        How the whole model treats light from inside.
    count
        So many of the photographs, even over them; None: all.
    ablation
        Whether the model is rendered without each of its parts, too.
    model
        The appearance's model, where something of it is to be another; None: as it is.
    rng
        For intervals.
    progress
        Called with a line of text now and then.

    Returns
    -------
    comparison : Comparison
    pictures : dict of str to bytes
        PNG files by name: photograph, rendering and relative error beside each other.

    Raises
    ------
    PhotographError, PhotographsError, RenderingError, GeometryError, SkinReflectanceError
        Where there is nothing to compare, or the model lacks a part.
    """
    begun = time.perf_counter()
    whole = assemble(appearance) if model is None else model
    mesh = own_mesh(appearance)
    caster = Caster(mesh)
    laid = FittedSurface.of(whole, mesh)
    interior = Interior.of(laid) if subsurface == "dipole" else None
    surface = _Surface(laid, caster, interior)
    fewer = {
        name: _Surface(FittedSurface.of(less, mesh), caster, interior)
        for name, less in (without_parts(whole, mesh) if ablation else {}).items()
    }
    chosen = photographs.chosen(count)
    drawn = {chosen[int(k)] for k in np.linspace(0, len(chosen) - 1, min(N_PICTURES, len(chosen)))}
    pairs: list[PairError] = []
    bands: list[NDArray[np.str_]] = []
    parts: dict[str, list[PairError]] = {}
    pictures: dict[str, bytes] = {}
    rows: list[dict[str, Any]] = []
    for number, shot in enumerate(chosen):
        if progress is not None:
            progress(f"{number + 1}/{len(chosen)} {shot.view} {shot.light}")
        photo = photographs.photograph(shot)
        made = surface.render(photographs, shot, subsurface)
        pair = _compare(photo, made, made.radiance)
        pairs.append(pair)
        bands.append(_bands(whole, made))
        told = {name: getattr(pair, name) for name in ("median", "noise", "ssim", "total_error")}
        lit = int(np.count_nonzero(pair.lit))
        rows.append({**dataclasses.asdict(shot), **told, "lit_pixels": lit})
        for name, image in _without(surface, fewer, photographs, shot, subsurface, made, ablation):
            parts.setdefault(name, []).append(_compare(photo, made, image))
        if shot in drawn:
            pictures[f"{shot.view}-{shot.light}"] = _sheet(photo, made, pair, shot)
    angle, of = _angle(whole, truth)
    comparison = Comparison(
        subject=photographs.subject,
        full=photograph_errors.summarize(pairs, rng=rng),
        by_kind=_by_kind(pairs, chosen, rng),
        ablation={name: photograph_errors.summarize(some, rng=rng) for name, some in parts.items()},
        by_band=photograph_errors.by_band(pairs, bands),
        typology_angle_deg=angle,
        typology_of=of,
        shots=tuple(rows),
        assumed=(*photographs.assumed, *whole.assumed),
        subsurface=subsurface,
        seconds=time.perf_counter() - begun,
    )
    return comparison, pictures


def evaluate_folders(
    appearance: Path,
    session: Path,
    out: Path,
    *,
    calibration: Path | None = None,
    subsurface: Subsurface = "dipole",
    translucency: str | None = None,
    count: int | None = None,
    ablation: bool = True,
    seed: int = 0,
    progress: Tell | None = None,
) -> dict[str, Any]:
    """Compare an APPEARANCE/ with a SESSION/ and write pictures and record to ``out``.

    Parameters are those of `evaluate`; the truth is found beside the appearance where it names one.

    Returns
    -------
    dict
        The record, see `skinrig.rendering.folder`.
    """
    folder.check(out)
    read, model = read_model(appearance, translucency=translucency)
    photographs = Photographs.of(session, read, calibration=calibration)
    named = str(read.parameters.get("truth", "") or "")
    beside = appearance.resolve().parent / named
    found = store.read(beside) if named and (beside / store.DOCUMENT_FILE).is_file() else None
    comparison, pictures = evaluate(
        read,
        photographs,
        truth=found,
        subsurface=subsurface,
        count=count,
        ablation=ablation,
        model=model,
        rng=np.random.default_rng(seed),
        progress=progress,
    )
    document = {
        "kind": "comparison with photographs",
        "appearance": appearance,
        "session": session,
        "inputs": {"session": dict(read.inputs).get("session"), "compared": str(session)},
        **comparison.document(),
    }
    return folder.write(out, images={}, pictures=pictures, document=document)


def _compare(photo: Photograph, made: Rendering, image: Float32Array) -> PairError:
    return photograph_errors.compare(photo, image, covered=made.covered, lit=made.lit)


def _by_kind(
    pairs: list[PairError], shots: tuple[Shot, ...], rng: np.random.Generator
) -> dict[str, Summary]:
    found: dict[str, list[PairError]] = {}
    for pair, shot in zip(pairs, shots, strict=True):
        if pair.lit.any():
            found.setdefault(shot.held_out, []).append(pair)
    return {kind: photograph_errors.summarize(some, rng=rng) for kind, some in found.items()}


def _without(
    surface: _Surface,
    fewer: Mapping[str, _Surface],
    photographs: Photographs,
    shot: Shot,
    subsurface: Subsurface,
    made: Rendering,
    ablation: bool,
) -> list[tuple[str, Float32Array]]:
    """Return renderings without parts."""
    if not ablation:
        return []
    out = [("without the surface", made.diffuse), ("without light from inside", made.surface)]
    if subsurface == "dipole":
        local = surface.render(photographs, shot, "local")
        out.append(("light that does not spread", local.radiance))
    for name, less in fewer.items():
        if name == "one lobe":  # nothing changes inside
            only = less.render(photographs, shot, "none")
            out.append((name, made.diffuse + only.surface))
        else:
            out.append((name, less.render(photographs, shot, subsurface).radiance))
    return out


def _bands(model: SkinReflectance, made: Rendering) -> NDArray[np.str_]:
    """Return the band of skin color of each pixel, "" beside measured skin."""
    height, width = made.covered.shape
    r_d = sample(np.asarray(model.r_d), made.uv.reshape(-1, 2), made.covered.reshape(-1))
    angle = typology_angle_deg(r_d * reflectance_share(model.eta)).reshape(height, width)
    return np.where(made.covered, bands_of(angle), "")


def reflectance_share(eta: float) -> float:
    """Return diffuse reflectance at normal incidence over R_d: light crosses the boundary twice.

    Examples
    --------
    >>> round(1.0 / reflectance_share(1.4), 3)
    1.114
    """
    return (1.0 - fresnel.normal_reflectance(eta)) * (1.0 - fresnel.diffuse_external(eta))


def _angle(model: SkinReflectance, truth: SkinAppearance | None) -> tuple[float, str]:
    if truth is not None and "reflectance" in truth.maps:
        known = truth.maps["reflectance"]
        return float(np.median(typology_angle_deg(known.values[known.mask]))), "truth"
    skin = model.r_d[model.valid] * reflectance_share(model.eta)
    return float(np.median(typology_angle_deg(skin))), "r_d"


def _sheet(photo: Photograph, made: Rendering, pair: PairError, shot: Shot) -> bytes:
    exposure = exposure_of(np.where(made.covered[..., None], photo.rgb, 0.0), made.coverage)
    on = made.coverage[..., None] > 0.5
    shown = [tone(np.where(on, image, 0.0), exposure) for image in (photo.rgb, made.radiance)]
    error = png.colorize(
        pair.signed, -MAX_SHOWN_ERROR, MAX_SHOWN_ERROR, scale="RdBu_r", valid=pair.lit
    )
    panels = [
        Panel("photograph", shown[0]),
        Panel("rendering", shown[1]),
        Panel(f"error, red +{100 * MAX_SHOWN_ERROR:.0f} %", error),
    ]
    held_out = f"{shot.view} {shot.light} ({shot.held_out} held out)"
    return sheet([panels], title=f"{held_out}: median {100 * pair.median:.1f} %")
