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
from skinrig import consent
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.drawing import png
from skinrig.errors import UnusableError, UsageError
from skinrig.rendering import folder, shadow
from skinrig.rendering.bases import reduced
from skinrig.rendering.camera import Camera, RenderingError
from skinrig.rendering.folder import Panel, exposure_of, sheet, tone
from skinrig.rendering.geometry import FittedSurface, own_mesh, read_mesh
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
        own = own_mesh(appearance)
        if mesh is None:
            return RenderModel(path, appearance, FittedSurface.of(model, own), "own")
        laid = FittedSurface.of(model, read_mesh(mesh), rest=own)
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


@dataclass(frozen=True, slots=True)
class Asked:
    """What a picture is to be of, where it is written, and how it is rendered."""

    camera: Camera
    lights: Sequence[Light]
    out: Path
    effort: Effort
    assumed: Sequence[str] = ()
    """What else was taken for granted."""

    def rendered(self, laid: FittedSurface, interior: Interior | None = None) -> Rendering:
        """Render a model, with the light inside it where that is known already."""
        return render(
            laid,
            self.camera,
            self.lights,
            subsurface=self.effort.subsurface,
            subpixels=self.effort.subpixels,
            shadow_samples=self.effort.shadow_samples,
            interior=None if interior is None else interior.of_surface(laid),
            progress=self.effort.progress,
        )

    def exposure(self, seen: Rendering) -> float:
        """Return the factor of the PNGs."""
        return self.effort.exposure or exposure_of(seen.radiance, seen.coverage)

    def record(self, subjects: Sequence[RenderModel], seen: Rendering) -> dict[str, Any]:
        """Return what the record of a rendering says of it."""
        own: Mapping[str, Any] = subjects[0].record()
        names = [light.name for light in self.lights]
        columns, rows = self.camera.image_size
        view = {"name": self.camera.serial, "place_mm": self.camera.center_mm}
        agreed = consent.merge_consent(*(subject.appearance for subject in subjects))
        return {
            **own,
            "appearances": [subject.path for subject in subjects],
            "assumed": list(dict.fromkeys([*own["assumed"], *self.assumed])),
            consent.CONSENT_KEY: agreed,
            "unit": RADIANCE_UNIT,
            "view": {**view, "columns": columns, "rows": rows},
            "lights": {name: names.count(name) for name in names},
            "subsurface": self.effort.subsurface,
            "samples": self.effort.subpixels**2,
            "shadow_samples": self.effort.shadow_samples,
            "seed": self.effort.seed,
            "skin_pixels": int(np.count_nonzero(seen.coverage > 0.5)),
            "measured_pixels": int(np.count_nonzero(seen.covered)),
            "lit_pixels": int(np.count_nonzero(seen.lit)),
        }


class _Drawing:
    """What is written to a folder, with the time that it took."""

    def __init__(self, out: Path) -> None:
        folder.check(out)
        self._out, self._start = out, time.perf_counter()

    def write(
        self,
        images: Mapping[str, Float32Array],
        pictures: Mapping[str, bytes],
        record: Mapping[str, Any],
        **told: Any,
    ) -> dict[str, Any]:
        """Write the folder; see `skinrig.rendering.folder.write`."""
        told["seconds"] = time.perf_counter() - self._start
        document = {**record, **told}
        return folder.write(self._out, images=images, pictures=pictures, document=document)


def draw(subject: RenderModel, asked: Asked, *, components: bool = False) -> dict[str, Any]:
    """Render one picture into a folder; see `skinrig.rendering.folder.write`.

    Parameters
    ----------
    subject, asked
        What is seen, and how.
    components
        Write light from inside and from the surface, too, and a sheet of the paper's figure 12.
    """
    drawing = _Drawing(asked.out)
    seen = asked.rendered(subject.laid)
    exposure = asked.exposure(seen)
    images: dict[str, Float32Array] = {"radiance": seen.radiance}
    shown = {"radiance": seen.radiance}
    if components:
        shown |= {"diffuse": seen.diffuse, "surface": seen.surface}
        images |= {**shown, "coverage": seen.coverage}
    pictures = {name: png.encode(tone(image, exposure)) for name, image in shown.items()}
    if components:
        pictures["components"] = sheet([component_panels(seen, exposure)])
    record = asked.record([subject], seen)
    return drawing.write(images, pictures, record, kind="picture", exposure=exposure)


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
        As of `Asked`.
    calibration
        CALIBRATION/ folder.

    Raises
    ------
    UnusableError
        The session holds no such photograph that the model has not seen.
    """
    drawing = _Drawing(out)
    photographs = Photographs.of(session, subject.appearance, calibration=calibration)
    shot = next((s for s in photographs.shots if (s.view, s.light) == (view, light)), None)
    if shot is None:
        some = ", ".join(f"{s.view} {s.light}" for s in photographs.shots[:8])
        raise UnusableError(
            f"--view {view} --light {light}: the session holds no such photograph that the model "
            f"has not seen; there are {some}{' ...' if len(photographs.shots) > 8 else ''}"
        )
    camera, lamp = photographs.camera(shot), photographs.light(shot)
    asked = Asked(camera, [lamp], out, effort, photographs.assumed)
    photo = photographs.photograph(shot).rgb.astype(np.float32)
    seen = asked.rendered(subject.laid)
    exposure = asked.exposure(seen)
    left = np.where(seen.coverage[..., None] > 0.5, photo - seen.diffuse, 0.0).astype(np.float32)
    images = {
        "photograph": photo,
        "diffuse": seen.diffuse,
        "photograph_less_diffuse": left,
        "radiance": seen.radiance,
        "surface": seen.surface,
        "coverage": seen.coverage,
    }
    pictures = {"components": sheet([component_panels(seen, exposure, photo)])}
    told = {"kind": "components", "exposure": exposure, "held_out": shot.held_out}
    record = asked.record([subject], seen)
    return drawing.write(images, pictures, record, session=session, **told)


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
    subjects: Sequence[RenderModel], ranks: Sequence[int], asked: Asked
) -> dict[str, Any]:
    """Render one view with models of several ranks, complete and the surface alone: figure 7.

    Parameters
    ----------
    subjects
        Fits; those of a wanted rank are used as they are, others are reduced from the one that
        has the fewest lobes above it.
    ranks
        Numbers of lobes.
    asked
        What is seen, and how.

    Raises
    ------
    RenderingError
        No model has as many lobes as a rank.
    """
    drawing = _Drawing(asked.out)
    effort = asked.effort
    models = {rank: _of_rank(subjects, rank, effort) for rank in ranks}
    if not models:
        raise UsageError("--bases: got none, expected numbers of lobes, as 1,2,4")
    interiors: dict[int, Interior] = {}
    rows: tuple[list[Panel], list[Panel]] = ([], [])
    images: dict[str, Float32Array] = {}
    against = max(ranks)
    exposure = 0.0
    pictures: dict[int, Rendering] = {}
    for rank, (subject, laid) in models.items():
        effort.progress(f"render with {rank} lobes")
        if effort.subsurface == "dipole" and id(subject) not in interiors:
            interiors[id(subject)] = Interior.of(laid)
        seen = pictures[rank] = asked.rendered(laid, interiors.get(id(subject)))
        exposure = exposure or asked.exposure(seen)
        how = "fitted" if laid is subject.laid else f"reduced from {subject.model.lobes.size}"
        rows[0].append(Panel(f"{rank} lobes, {how}", tone(seen.radiance, exposure)))
        rows[1].append(Panel("surface reflection", tone(seen.surface, exposure)))
        images |= {f"radiance_{rank}": seen.radiance, f"surface_{rank}": seen.surface}
    best = pictures[against].surface
    bases = [
        {
            "lobes": rank,
            "appearance": subject.path,
            "refitted": laid is subject.laid,
            f"surface_difference_from_{against}": _difference(
                pictures[rank].surface, best, pictures[rank].lit
            ),
        }
        for rank, (subject, laid) in models.items()
    ]
    told = {"kind": "bases", "exposure": exposure, "bases": bases}
    record = asked.record(subjects, seen)
    return drawing.write(images, {"bases": sheet(rows)}, record, **told)


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
    drawing = _Drawing(out)
    media = {"most_translucent": MIN_SIGMA_TR_PER_MM, "least_translucent": MAX_SIGMA_TR_PER_MM}
    rows, widths = [], []
    images: dict[str, Float32Array] = {}
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
            words = "without spreading"
            if sigma is not None:
                words = "sigma_tr " + ", ".join(f"{value:.4g}" for value in sigma)
            row.append(Panel(f"{boundary.name}, {words}", tone(seen.radiance, exposure)))
            images[f"{boundary.name.replace(' ', '_')}_{name}"] = seen.radiance
            rise = shadow.rise_mm(*shadow.profile(seen))
            skin = {"skin": boundary.name, "name": name}
            widths.append({**skin, "sigma_tr_per_mm": sigma, "rise_mm": rise})
        rows.append(row)
    title = (
        "Shadow boundary by sigma_tr of red, green, blue in 1/mm; the least sigma_tr is the most "
        f"translucent skin; {shadow.BOUNDARY_WIDTH_MM:g} mm across"
    )
    told = {
        "kind": "shadow boundary",
        "unit": RADIANCE_UNIT,
        "boundaries": widths,
        "samples": effort.subpixels**2,
        "labels": "the paper's figures 17 and 18 say translucency, 1/sigma_tr, and print "
        "sigma_tr: here everything is labelled by sigma_tr",
    }
    pictures = {"shadow_boundary": sheet(rows, title=title)}
    return drawing.write(images, pictures, subject.record(), **told)


def _of_rank(
    subjects: Sequence[RenderModel], rank: int, effort: Effort
) -> tuple[RenderModel, FittedSurface]:
    enough = [s for s in subjects if s.model.lobes.size >= rank]
    if not enough:
        reduced(subjects[0].model, rank, rng=np.random.default_rng(effort.seed))
        raise RenderingError(f"bases: got {rank}, which no given model has")
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
