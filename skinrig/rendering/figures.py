"""Draw the figures of `skinrig render`: image, components, fewer basis BRDFs, shadow boundary."""

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
from skinrig.console import select_attributes
from skinrig.drawing import png
from skinrig.errors import UnusableError, UsageError
from skinrig.rendering import folder, shadow
from skinrig.rendering.bases import reduce_lobes
from skinrig.rendering.camera import Camera, RenderingError
from skinrig.rendering.folder import Panel, apply_tone_curve, choose_exposure, encode_sheet
from skinrig.rendering.geometry import FittedSurface, read_mesh, read_own_mesh
from skinrig.rendering.interior import Interior
from skinrig.rendering.lights import Light
from skinrig.rendering.photographs.held_out import HeldOutPhotographs
from skinrig.rendering.render import Rendering, Subsurface, render_surface
from skinrig.rendering.request import read_model
from skinrig.rendering.shadow import MAX_SIGMA_TR_PER_MM, MIN_SIGMA_TR_PER_MM, ShadowBoundary
from skinrig.rendering.transport import PATH_SAMPLES, SkinExchange, Transport

RADIANCE_UNIT = (
    "radiance over that of a perfect white Lambertian patch facing a light of intensity 1; "
    "camera RGB, white balanced"
)


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """Settings of a rendering."""

    subsurface: Subsurface = "dipole"
    subpixels: int = 2
    """Rays along each side of a pixel."""
    shadow_samples: int = 4
    exposure: float | None = None
    """Factor of the PNGs; None: automatic by skin brightness, equal for all images of a sheet."""
    transport: Transport = "direct"
    """"path": with light that skin reflects onto skin."""
    path_samples: int = PATH_SAMPLES
    """Directions of paths per element of the skin, for "path"."""
    seed: int = 0
    progress: Callable[[str], None] = field(default=lambda _: None)


@dataclass(frozen=True, slots=True, eq=False)
class RenderModel:
    """A fitted model on a mesh."""

    path: Path
    appearance: SkinAppearance
    surface: FittedSurface
    mesh: str
    """Description of the mesh, for the record."""

    @property
    def model(self) -> SkinReflectance:
        """The model."""
        return self.surface.model

    @staticmethod
    def of(path: Path, *, mesh: Path | None = None, translucency: str | None = None) -> RenderModel:
        """Read an appearance and put its maps on its own mesh, or on another of the same layout."""
        appearance, model = read_model(path, translucency=translucency)
        own = read_own_mesh(appearance)
        if mesh is None:
            return RenderModel(path, appearance, FittedSurface.of(model, own), "own")
        laid = FittedSurface.of(model, read_mesh(mesh), rest=own)
        return RenderModel(path, appearance, laid, str(mesh))

    def record(self) -> dict[str, Any]:
        """Return the model's entries of a rendering's record."""
        valid = self.model.valid & self.surface.atlas.covered
        return {
            "appearance": self.path,
            "source": self.appearance.source,
            "mesh": self.mesh,
            "normals_carried_along": self.surface.is_transferred,
            "lobes": self.model.lobes.size,
            "assumed": list(self.model.assumed),
            consent.CONSENT_KEY: consent.merge_consent(self.appearance),
            "measured_share": float(valid.sum() / max(self.surface.atlas.covered.sum(), 1)),
        }


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """Camera, lights, output folder and settings of a rendering."""

    camera: Camera
    lights: Sequence[Light]
    out: Path
    settings: RenderSettings
    assumed: Sequence[str] = ()
    """Additional assumptions."""

    def render(self, surface: FittedSurface, interior: Interior | None = None) -> Rendering:
        """Render a model, optionally with its precomputed interior."""
        effort, caster = self.settings, Caster(surface.mesh)
        return render_surface(
            surface,
            self.camera,
            self.lights,
            subsurface=effort.subsurface,
            subpixels=effort.subpixels,
            shadow_samples=effort.shadow_samples,
            caster=caster,
            interior=None if interior is None else interior.with_surface(surface),
            exchange=SkinExchange.for_transport(
                effort.transport, surface, caster, samples=effort.path_samples, seed=effort.seed
            ),
            progress=effort.progress,
        )

    def exposure(self, rendering: Rendering) -> float:
        """Return the factor of the PNGs."""
        return self.settings.exposure or choose_exposure(rendering.radiance, rendering.coverage)

    def record(self, subjects: Sequence[RenderModel], rendering: Rendering) -> dict[str, Any]:
        """Return the record of a rendering."""
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
            **select_attributes(self.settings, "subsurface", "transport"),
            "samples": self.settings.subpixels**2,
            "shadow_samples": self.settings.shadow_samples,
            "seed": self.settings.seed,
            "skin_pixels": int(np.count_nonzero(rendering.coverage > 0.5)),
            "measured_pixels": int(np.count_nonzero(rendering.covered)),
            "lit_pixels": int(np.count_nonzero(rendering.lit)),
        }


class _Drawing:
    """Output folder of a figure, with the elapsed time."""

    def __init__(self, out: Path) -> None:
        folder.check(out)
        self._out, self._start = out, time.perf_counter()

    def write(
        self,
        images: Mapping[str, Float32Array],
        pictures: Mapping[str, bytes],
        record: Mapping[str, Any],
        **details: Any,
    ) -> dict[str, Any]:
        """Write the folder; see `skinrig.rendering.folder.write`."""
        details["seconds"] = time.perf_counter() - self._start
        document = {**record, **details}
        return folder.write(self._out, images=images, pictures=pictures, document=document)


def draw_rendering(
    subject: RenderModel, request: RenderRequest, *, components: bool = False
) -> dict[str, Any]:
    """Render one image into a folder; see `skinrig.rendering.folder.write`.

    Parameters
    ----------
    subject, request
        Model, and camera, lights and settings.
    components
        Also write diffuse and specular components, and a sheet of the paper's figure 12.
    """
    drawing = _Drawing(request.out)
    seen = request.render(subject.surface)
    exposure = request.exposure(seen)
    images: dict[str, Float32Array] = {"radiance": seen.radiance}
    shown = {"radiance": seen.radiance}
    if components:
        shown |= {"diffuse": seen.diffuse, "surface": seen.surface}
        images |= {**shown, "coverage": seen.coverage}
    pictures = {
        name: png.encode(apply_tone_curve(image, exposure)) for name, image in shown.items()
    }
    if components:
        pictures["components"] = encode_sheet([build_component_panels(seen, exposure)])
    record = request.record([subject], seen)
    return drawing.write(images, pictures, record, kind="picture", exposure=exposure)


def draw_photograph(
    subject: RenderModel,
    session: Path,
    view: str,
    light: str,
    out: Path,
    effort: RenderSettings,
    *,
    calibration: Path | None = None,
) -> dict[str, Any]:
    """Decompose a photograph that was held out of the fit: the paper's figure 12, (a) to (e).

    Parameters
    ----------
    subject
        The fitted model on its own mesh.
    session
        SESSION/ with the photograph.
    view, light
        Names of its camera and light.
    out, effort
        As in `RenderRequest`.
    calibration
        CALIBRATION/ folder.

    Raises
    ------
    UnusableError
        If the session has no such held-out photograph.
    """
    drawing = _Drawing(out)
    photographs = HeldOutPhotographs.of(session, subject.appearance, calibration=calibration)
    shot = next((s for s in photographs.shots if (s.view, s.light) == (view, light)), None)
    if shot is None:
        some = ", ".join(f"{s.view} {s.light}" for s in photographs.shots[:8])
        raise UnusableError(
            f"--view {view} --light {light}: not a held-out photograph of the session, expected "
            f"one of {some}{' ...' if len(photographs.shots) > 8 else ''}; choose one"
        )
    camera, lamp = photographs.camera(shot), photographs.light(shot)
    asked = RenderRequest(camera, [lamp], out, effort, photographs.assumed)
    photo = photographs.photograph(shot).rgb.astype(np.float32)
    seen = asked.render(subject.surface)
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
    pictures = {"components": encode_sheet([build_component_panels(seen, exposure, photo)])}
    facts = {"kind": "components", "exposure": exposure, "held_out": shot.held_out}
    record = asked.record([subject], seen)
    return drawing.write(images, pictures, record, session=session, **facts)


def build_component_panels(
    rendering: Rendering, exposure: float, photograph: FloatArray | None = None
) -> list[Panel]:
    """Build the panels of the paper's figure 12; (a) and (c) only with a photograph.

    Parameters
    ----------
    rendering
        The rendering.
    exposure
        Factor of all panels.
    photograph
        Photograph in the unit of the rendering, (H, W, 3).
    """

    def panel(label: str, image: FloatArray) -> Panel:
        return Panel(label, apply_tone_curve(image, exposure))

    out = [] if photograph is None else [panel("(a) photograph", photograph)]
    out.append(panel("(b) diffuse component", rendering.diffuse))
    if photograph is not None:
        skin = rendering.coverage[..., None] > 0.5
        out.append(
            panel("(c) photograph minus (b)", np.where(skin, photograph - rendering.diffuse, 0.0))
        )
    out.append(panel("(d) model", rendering.radiance))
    out.append(panel("(e) specular component", rendering.surface))
    return out


def draw_bases(
    subjects: Sequence[RenderModel], ranks: Sequence[int], request: RenderRequest
) -> dict[str, Any]:
    """Render one view with models of several ranks, complete and specular only: figure 7.

    Parameters
    ----------
    subjects
        Fitted models. A requested rank is taken from them if available, else reduced from the
        model with the next larger rank.
    ranks
        Numbers of basis BRDFs.
    request
        Camera, lights and settings.

    Raises
    ------
    RenderingError
        If every model has fewer basis BRDFs than a rank.
    """
    drawing = _Drawing(request.out)
    effort = request.settings
    models = {rank: _reduce_subjects(subjects, rank, effort) for rank in ranks}
    if not models:
        raise UsageError("--bases: got none, expected numbers of basis BRDFs, such as 1,2,4")
    interiors: dict[int, Interior] = {}
    rows: tuple[list[Panel], list[Panel]] = ([], [])
    images: dict[str, Float32Array] = {}
    against = max(ranks)
    exposure = 0.0
    pictures: dict[int, Rendering] = {}
    for rank, (subject, laid) in models.items():
        effort.progress(f"render with {rank} basis BRDFs")
        if effort.subsurface == "dipole" and id(subject) not in interiors:
            interiors[id(subject)] = Interior.of(laid)
        seen = pictures[rank] = request.render(laid, interiors.get(id(subject)))
        exposure = exposure or request.exposure(seen)
        how = "fitted" if laid is subject.surface else f"reduced from {subject.model.lobes.size}"
        rows[0].append(
            Panel(f"{rank} basis BRDFs, {how}", apply_tone_curve(seen.radiance, exposure))
        )
        rows[1].append(Panel("specular component", apply_tone_curve(seen.surface, exposure)))
        images |= {f"radiance_{rank}": seen.radiance, f"surface_{rank}": seen.surface}
    best = pictures[against].surface
    bases = [
        {
            "lobes": rank,
            "appearance": subject.path,
            "refitted": laid is subject.surface,
            f"surface_difference_from_{against}": _relative_difference(
                pictures[rank].surface, best, pictures[rank].lit
            ),
        }
        for rank, (subject, laid) in models.items()
    ]
    facts = {"kind": "bases", "exposure": exposure, "bases": bases}
    record = request.record(subjects, seen)
    return drawing.write(images, {"bases": encode_sheet(rows)}, record, **facts)


def draw_shadow_boundary(
    subject: RenderModel, out: Path, effort: RenderSettings, *, size_px: int
) -> dict[str, Any]:
    """Render a shadow boundary for the paper's two extremes of sigma_tr, on face and flat patch.

    Parameters
    ----------
    subject
        The face; the flat patch has its median maps.
    out
        Folder to write.
    effort
        Settings; rendered with the dipole and, for comparison, without lateral scattering.
    size_px
        Width of each image, px.
    """
    drawing = _Drawing(out)
    media = {"most_translucent": MIN_SIGMA_TR_PER_MM, "least_translucent": MAX_SIGMA_TR_PER_MM}
    rows, widths = [], []
    images: dict[str, Float32Array] = {}
    for boundary in (
        ShadowBoundary.on_face(subject.surface, size_px=size_px),
        ShadowBoundary.on_plane(subject.model, size_px=size_px),
    ):
        row: list[Panel] = []
        exposure = effort.exposure
        for name, sigma in [*media.items(), ("without_spreading", None)]:
            effort.progress(f"render {boundary.name}, {name.replace('_', ' ')}")
            seen = boundary.render(sigma, subpixels=effort.subpixels)
            exposure = exposure or choose_exposure(seen.radiance, seen.coverage)
            words = "without lateral scattering"
            if sigma is not None:
                words = "sigma_tr " + ", ".join(f"{value:.4g}" for value in sigma)
            row.append(
                Panel(f"{boundary.name}, {words}", apply_tone_curve(seen.radiance, exposure))
            )
            images[f"{boundary.name.replace(' ', '_')}_{name}"] = seen.radiance
            rise = shadow.measure_rise_mm(*shadow.measure_profile(seen))
            skin = {"skin": boundary.name, "name": name}
            widths.append({**skin, "sigma_tr_per_mm": sigma, "rise_mm": rise})
        rows.append(row)
    title = (
        "Shadow boundary by sigma_tr of red, green, blue in 1/mm; smallest sigma_tr: most "
        f"translucent skin; width {shadow.BOUNDARY_WIDTH_MM:g} mm"
    )
    facts = {
        "kind": "shadow boundary",
        "unit": RADIANCE_UNIT,
        "boundaries": widths,
        "samples": effort.subpixels**2,
        "labels": "the paper's figures 17 and 18 are labeled translucency, 1/sigma_tr, but "
        "print sigma_tr: here all labels are sigma_tr",
    }
    pictures = {"shadow_boundary": encode_sheet(rows, title=title)}
    return drawing.write(images, pictures, subject.record(), **facts)


def _reduce_subjects(
    subjects: Sequence[RenderModel], rank: int, effort: RenderSettings
) -> tuple[RenderModel, FittedSurface]:
    enough = [s for s in subjects if s.model.lobes.size >= rank]
    if not enough:
        reduce_lobes(subjects[0].model, rank, rng=np.random.default_rng(effort.seed))
        raise RenderingError(
            f"--bases: got {rank}, expected at most the basis BRDFs of a given model; lower it"
        )
    subject = min(enough, key=lambda s: s.model.lobes.size)
    if subject.model.lobes.size == rank:
        return subject, subject.surface
    model = reduce_lobes(subject.model, rank, rng=np.random.default_rng(effort.seed))
    return subject, subject.surface.with_lobes(model)


def _relative_difference(one: Float32Array, other: Float32Array, lit: BoolArray) -> float:
    """Return the mean absolute difference over the mean, on lit pixels; NaN without any."""
    if not lit.any() or not other[lit].mean() > 0.0:
        return float("nan")
    return float(np.abs(one[lit] - other[lit]).mean() / other[lit].mean())
