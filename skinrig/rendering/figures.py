"""What `skinrig render` draws: a picture, its components, fewer lobes, a shadow boundary."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance
from rigsim.render import Caster
from skinrig import consent
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.drawing import png
from skinrig.errors import UnusableError, UsageError
from skinrig.rendering import folder, shadow
from skinrig.rendering.bases import RankError, reduced
from skinrig.rendering.camera import Camera
from skinrig.rendering.geometry import FittedSurface, own_mesh, read_mesh
from skinrig.rendering.images import Panel, exposure_of, sheet, tone
from skinrig.rendering.interior import Interior
from skinrig.rendering.lights import Light
from skinrig.rendering.photographs.held_out import Photographs
from skinrig.rendering.render import Rendering, Subsurface, render
from skinrig.rendering.request import read_model
from skinrig.rendering.shadow import MAX_SIGMA_TR_PER_MM, MIN_SIGMA_TR_PER_MM, Boundary

RADIANCE_UNIT = (
    "radiance over that of a perfect white Lambertian patch that faces a light of intensity 1; "
    "camera RGB, white balanced"
)


@dataclass(frozen=True, slots=True)
class Effort:
    """How a picture is rendered."""

    subsurface: Subsurface = "dipole"
    subpixels: int = 2
    """Rays along each side of a pixel."""
    shadow_samples: int = 4
    exposure: float | None = None
    """Factor of the PNGs; None: that of well shown skin, the same for all pictures of a sheet."""
    seed: int = 0
    progress: Callable[[str], None] = field(default=lambda _: None)


@dataclass(frozen=True, slots=True, eq=False)
class RenderModel:
    """A fitted model on a mesh."""

    path: Path
    appearance: SkinAppearance
    laid: FittedSurface
    mesh: str
    """Which mesh, for the record."""

    @property
    def model(self) -> SkinReflectance:
        """The model."""
        return self.laid.model

    @staticmethod
    def of(path: Path, *, mesh: Path | None = None, translucency: str | None = None) -> RenderModel:
        """Read an appearance and lay its maps on its own mesh, or on another of the same layout."""
        appearance, model = read_model(path, translucency=translucency)
        if mesh is None:
            return RenderModel(
                path, appearance, FittedSurface.of(model, own_mesh(appearance)), "own"
            )
        other = read_mesh(mesh)
        laid = FittedSurface.of(model, other, rest=own_mesh(appearance))
        return RenderModel(path, appearance, laid, str(mesh))

    def record(self) -> dict[str, Any]:
        """Return what a rendering's record says of the model."""
        valid = self.model.valid & self.laid.atlas.covered
        return {
            "appearance": self.path,
            "source": self.appearance.source,
            "mesh": self.mesh,
            "normals_carried_along": self.laid.carried,
            "lobes": self.model.lobes.size,
            "assumed": list(self.model.assumed),
            consent.CONSENT_KEY: consent.merge_consent(self.appearance),
            "measured_share": float(valid.sum() / max(self.laid.atlas.covered.sum(), 1)),
        }


def draw(
    subject: RenderModel,
    camera: Camera,
    lights: Sequence[Light],
    out: Path,
    effort: Effort,
    *,
    components: bool = False,
    assumed: Sequence[str] = (),
) -> dict[str, Any]:
    """Render one picture into a folder; see `skinrig.rendering.folder.write`.

    Parameters
    ----------
    subject, camera, lights
        What is seen.
    out
        Folder to write.
    effort
        How.
    components
        Write light from inside and from the surface, too, and a sheet of the paper's figure 12.
    assumed
        What else was taken for granted.
    """
    folder.check(out)
    start = time.perf_counter()
    seen = _rendered(subject.laid, camera, lights, effort)
    seconds = time.perf_counter() - start
    exposure = effort.exposure or exposure_of(seen.radiance, seen.coverage)
    images: dict[str, Float32Array] = {"radiance": seen.radiance}
    pictures = {"radiance": _png(seen.radiance, exposure)}
    if components:
        images |= {"diffuse": seen.diffuse, "surface": seen.surface, "coverage": seen.coverage}
        for name in ("diffuse", "surface"):
            pictures[name] = _png(images[name], exposure)
        pictures["components"] = sheet([component_panels(seen, exposure)])
    return folder.write(
        out,
        images=images,
        pictures=pictures,
        document={
            **_record([subject], camera, lights, effort, seen, assumed),
            "kind": "picture",
            "exposure": exposure,
            "seconds": seconds,
        },
    )


def draw_photograph(
    subject: RenderModel,
    session: Path,
    view: str,
    light: str,
    out: Path,
    effort: Effort,
    *,
    calibration: Path | None = None,
) -> dict[str, Any]:
    """Take a photograph that the model has not seen apart: the paper's figure 12, (a) to (e).

    Parameters
    ----------
    subject
        The fitted model on its own mesh.
    session
        SESSION/ that holds the photograph.
    view, light
        Names of its camera and light.
    out, effort
        As for `draw`.
    calibration
        CALIBRATION/ folder.

    Raises
    ------
    UnusableError
        The session holds no such photograph that the model has not seen.
    """
    folder.check(out)
    photographs = Photographs.of(session, subject.appearance, calibration=calibration)
    shot = next((s for s in photographs.shots if (s.view, s.light) == (view, light)), None)
    if shot is None:
        some = ", ".join(f"{s.view} {s.light}" for s in photographs.shots[:8])
        raise UnusableError(
            f"--view {view} --light {light}: the session holds no such photograph that the model "
            f"has not seen; there are {some}{' ...' if len(photographs.shots) > 8 else ''}"
        )
    start = time.perf_counter()
    camera, lamp = photographs.camera(shot), photographs.light(shot)
    photo = photographs.photograph(shot).rgb.astype(np.float32)
    seen = _rendered(subject.laid, camera, [lamp], effort)
    exposure = effort.exposure or exposure_of(seen.radiance, seen.coverage)
    left = np.where(seen.coverage[..., None] > 0.5, photo - seen.diffuse, 0.0).astype(np.float32)
    return folder.write(
        out,
        images={
            "photograph": photo,
            "diffuse": seen.diffuse,
            "photograph_less_diffuse": left,
            "radiance": seen.radiance,
            "surface": seen.surface,
            "coverage": seen.coverage,
        },
        pictures={"components": sheet([component_panels(seen, exposure, photo)])},
        document={
            **_record([subject], camera, [lamp], effort, seen, photographs.assumed),
            "kind": "components",
            "exposure": exposure,
            "session": session,
            "held_out": shot.held_out,
            "seconds": time.perf_counter() - start,
        },
    )


def component_panels(
    seen: Rendering, exposure: float, photograph: FloatArray | None = None
) -> list[Panel]:
    """Return the panels of the paper's figure 12, those that need a photograph where there is one.

    Parameters
    ----------
    seen
        The rendering.
    exposure
        Of all panels.
    photograph
        In the unit of the rendering, (H, W, 3).
    """

    def panel(label: str, image: FloatArray) -> Panel:
        return Panel(label, tone(image, exposure))

    out = [] if photograph is None else [panel("(a) photograph", photograph)]
    out.append(panel("(b) light from inside", seen.diffuse))
    if photograph is not None:
        skin = seen.coverage[..., None] > 0.5
        out.append(panel("(c) photograph less (b)", np.where(skin, photograph - seen.diffuse, 0.0)))
    out.append(panel("(d) model", seen.radiance))
    out.append(panel("(e) surface reflection", seen.surface))
    return out


def draw_bases(
    subjects: Sequence[RenderModel],
    ranks: Sequence[int],
    camera: Camera,
    lights: Sequence[Light],
    out: Path,
    effort: Effort,
    *,
    assumed: Sequence[str] = (),
) -> dict[str, Any]:
    """Render one view with models of several ranks, complete and the surface alone: figure 7.

    Parameters
    ----------
    subjects
        Fits; those of a wanted rank are used as they are, others are reduced from the one that
        has the fewest lobes above it.
    ranks
        Numbers of lobes.
    camera, lights, out, effort, assumed
        As for `draw`.

    Raises
    ------
    skinrig.rendering.bases.RankError
        No model has as many lobes as a rank.
    """
    folder.check(out)
    models = {rank: _of_rank(subjects, rank, effort) for rank in ranks}
    interiors: dict[int, Interior] = {}
    rows: tuple[list[Panel], list[Panel]] = ([], [])
    images: dict[str, Float32Array] = {}
    exposure, seen = effort.exposure, None
    start = time.perf_counter()
    against = max(ranks)
    pictures: dict[int, Rendering] = {}
    for rank, (subject, laid) in models.items():
        effort.progress(f"render with {rank} lobes")
        if effort.subsurface == "dipole" and id(subject) not in interiors:
            interiors[id(subject)] = Interior.of(laid)
        seen = _rendered(laid, camera, lights, effort, interiors.get(id(subject)))
        pictures[rank] = seen
        exposure = exposure or exposure_of(seen.radiance, seen.coverage)
        how = "fitted" if laid is subject.laid else f"reduced from {subject.model.lobes.size}"
        rows[0].append(Panel(f"{rank} lobes, {how}", tone(seen.radiance, exposure)))
        rows[1].append(Panel("surface reflection", tone(seen.surface, exposure)))
        images |= {f"radiance_{rank}": seen.radiance, f"surface_{rank}": seen.surface}
    if seen is None or exposure is None:
        raise UsageError("--bases: got none, expected numbers of lobes, as 1,2,4")
    differences = {
        rank: _difference(shown.surface, pictures[against].surface, shown.lit)
        for rank, shown in pictures.items()
    }
    return folder.write(
        out,
        images=images,
        pictures={"bases": sheet(rows)},
        document={
            **_record(list(subjects), camera, lights, effort, seen, assumed),
            "kind": "bases",
            "exposure": exposure,
            "seconds": time.perf_counter() - start,
            "bases": [
                {
                    "lobes": rank,
                    "appearance": models[rank][0].path,
                    "refitted": models[rank][1] is models[rank][0].laid,
                    f"surface_difference_from_{against}": differences[rank],
                }
                for rank in ranks
            ],
        },
    )


def draw_shadow_boundary(
    subject: RenderModel, out: Path, effort: Effort, *, size_px: int
) -> dict[str, Any]:
    """Render a shadow's edge by the paper's two extremes of sigma_tr, on face and flat patch.

    Parameters
    ----------
    subject
        The face; the flat patch has its median maps.
    out
        Folder to write.
    effort
        How; light spreads by the dipole, and leaves where it entered for comparison.
    size_px
        Columns of each picture.
    """
    folder.check(out)
    media = {"most_translucent": MIN_SIGMA_TR_PER_MM, "least_translucent": MAX_SIGMA_TR_PER_MM}
    rows, widths = [], []
    images: dict[str, Float32Array] = {}
    start = time.perf_counter()
    for boundary in (
        Boundary.on_face(subject.laid, size_px=size_px),
        Boundary.on_plane(subject.model, size_px=size_px),
    ):
        row: list[Panel] = []
        exposure = effort.exposure
        for name, sigma in [*media.items(), ("without_spreading", None)]:
            effort.progress(f"render {boundary.name}, {name.replace('_', ' ')}")
            seen = boundary.shown(sigma, subpixels=effort.subpixels)
            exposure = exposure or exposure_of(seen.radiance, seen.coverage)
            words = "without spreading" if sigma is None else _words(sigma)
            row.append(Panel(f"{boundary.name}, {words}", tone(seen.radiance, exposure)))
            images[f"{boundary.name.replace(' ', '_')}_{name}"] = seen.radiance
            rise = shadow.rise_mm(*shadow.profile(seen))
            entry = {"skin": boundary.name, "sigma_tr_per_mm": sigma, "rise_mm": rise}
            widths.append({**entry, "name": name})
        rows.append(row)
    title = (
        "Shadow boundary by sigma_tr of red, green, blue in 1/mm; the least sigma_tr is the most "
        f"translucent skin; {shadow.BOUNDARY_WIDTH_MM:g} mm across"
    )
    return folder.write(
        out,
        images=images,
        pictures={"shadow_boundary": sheet(rows, title=title)},
        document={
            **subject.record(),
            "kind": "shadow boundary",
            "unit": RADIANCE_UNIT,
            "boundaries": widths,
            "seconds": time.perf_counter() - start,
            "samples": effort.subpixels**2,
            "labels": "the paper's figures 17 and 18 say translucency, 1/sigma_tr, and print "
            "sigma_tr: here everything is labelled by sigma_tr",
        },
    )


def _words(sigma: Sequence[float]) -> str:
    return "sigma_tr " + ", ".join(f"{value:.4g}" for value in sigma)


def _png(image: FloatArray, exposure: float) -> bytes:

    return png.encode(tone(image, exposure))


def _rendered(
    laid: FittedSurface,
    camera: Camera,
    lights: Sequence[Light],
    effort: Effort,
    interior: Interior | None = None,
) -> Rendering:
    return render(
        laid.model,
        laid,
        camera,
        lights,
        subsurface=effort.subsurface,
        subpixels=effort.subpixels,
        shadow_samples=effort.shadow_samples,
        interior=None if interior is None else interior.of_surface(laid),
        caster=Caster(laid.mesh),
        progress=effort.progress,
    )


def _of_rank(
    subjects: Sequence[RenderModel], rank: int, effort: Effort
) -> tuple[RenderModel, FittedSurface]:
    enough = [s for s in subjects if s.model.lobes.size >= rank]
    if not enough:
        reduced(subjects[0].model, rank, rng=np.random.default_rng(effort.seed))
        raise RankError(f"bases: got {rank}, which no given model has")
    subject = min(enough, key=lambda s: s.model.lobes.size)
    if subject.model.lobes.size == rank:
        return subject, subject.laid
    model = reduced(subject.model, rank, rng=np.random.default_rng(effort.seed))
    return subject, subject.laid.with_lobes(model)


def _difference(one: Float32Array, other: Float32Array, lit: BoolArray) -> float:
    """Return the mean absolute difference over the mean, on lit pixels; NaN without any."""
    if not lit.any() or not other[lit].mean() > 0.0:
        return float("nan")
    return float(np.abs(one[lit] - other[lit]).mean() / other[lit].mean())


def _record(
    subjects: Sequence[RenderModel],
    camera: Camera,
    lights: Sequence[Light],
    effort: Effort,
    seen: Rendering,
    assumed: Sequence[str],
) -> dict[str, Any]:
    own: Mapping[str, Any] = subjects[0].record()
    told = dict.fromkeys([*own["assumed"], *assumed])
    names = [light.name for light in lights]
    return {
        **own,
        "appearances": [subject.path for subject in subjects],
        "assumed": list(told),
        consent.CONSENT_KEY: consent.merge_consent(*(subject.appearance for subject in subjects)),
        "unit": RADIANCE_UNIT,
        "view": {
            "name": camera.serial,
            "place_mm": camera.center_mm,
            "columns": camera.image_size[0],
            "rows": camera.image_size[1],
        },
        "lights": {name: names.count(name) for name in names},
        "subsurface": effort.subsurface,
        "samples": effort.subpixels**2,
        "shadow_samples": effort.shadow_samples,
        "seed": effort.seed,
        "skin_pixels": int(np.count_nonzero(seen.coverage > 0.5)),
        "measured_pixels": int(np.count_nonzero(seen.covered)),
        "lit_pixels": int(np.count_nonzero(seen.lit)),
    }
