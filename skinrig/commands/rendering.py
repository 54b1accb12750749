"""`skinrig render`: images of a fitted skin model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skinrig import errors
from skinrig.command_line.options import Json, Out, choice, command
from skinrig.console import Console, select_attributes
from skinrig.errors import UnusableError, UsageError

if TYPE_CHECKING:
    from skinrig.rendering.figures import RenderSettings


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Options of the camera, the lights, the accuracy and the output images.

    Attributes
    ----------
    view
        View of the rig, such as C03, or camera position, mm: 0,0,700.
    light
        Light of the rig (L017), direction towards a light (1,1,2), or light position, mm
        (at:300,200,600); add *FACTOR or *R,G,B to scale its intensity; repeatable.
    environment
        Environment map: latitude-longitude OpenEXR file.
    environment_lights
        Number of lights sampled from the environment map.
    mesh
        Mesh with the maps' texture coordinates: OBJ, PLY or .npz; default: the maps' own.
    rig
        Rig of the views and lights in --view and --light.
    calibration
        CALIBRATION/ folder; default: the rig's nominal geometry.
    size_px
        Width of the image, pixels.
    fov
        Horizontal field of view of a camera given by its position, degrees.
    look_at
        Target point of a camera given by its position, mm.
    samples
        Rays per pixel, a square number: 1, 4, 9, 16 ...
    shadow_samples
        Shadow rays per light and camera ray.
    light_radius
        Radius of the lights' discs, mm (distant lights: at 700 mm); default: the rig's, 10.
    subsurface
        Subsurface scattering: dipole (lateral), local (diffuse albedo without lateral scattering)
        or none (specular reflection only).
    transport
        Light transport: direct (light of the lamps alone) or path (also light that skin reflects
        onto skin, by Monte Carlo).
    path_samples
        Directions of paths per element of the skin (--transport path).
    translucency
        sigma_tr of red, green and blue at all texels, 1/mm: 0.3558,0.7932,1.5173; default: the
        map's.
    components
        Also write subsurface and specular reflection as separate images.
    bases
        Compare numbers of basis BRDFs, at most the fitted number: 1,2,4.
    exposure
        Exposure factor of the PNGs; default: set from the brightness of skin.
    against
        SESSION/ folder whose held-out photographs (reconstruct --hold-out) are compared with
        renderings; with --components, the photograph of --view and --light is decomposed instead.
    photographs
        Maximum number of compared photographs, at equal steps over the held-out ones (--against).
    seed
        Random seed of the environment's lights and of --bases.
    shadow_boundary
        Render a card's shadow on the forehead and on a flat patch for the smallest and largest
        sigma_tr, with a fixed view and light.
    ablation
        Also compare with each part of the model removed (with --against).
    """

    view: str = "0,0,700"
    light: list[str] | None = None
    environment: Path | None = None
    environment_lights: int = 64
    mesh: Path | None = None
    rig: str = "dome"
    calibration: Path | None = None
    size_px: int = 512
    fov: float = 25.0
    look_at: str = "0,0,0"
    samples: int = 4
    shadow_samples: int = 4
    light_radius: float | None = None
    subsurface: Annotated[str, choice("dipole", "local", "none")] = "dipole"
    transport: Annotated[str, choice("direct", "path")] = "direct"
    path_samples: int = 64
    translucency: str | None = None
    components: bool = False
    bases: str | None = None
    shadow_boundary: bool = False
    exposure: float | None = None
    against: Path | None = None
    photographs: int = 24
    ablation: Annotated[bool, typer.Option("--ablation/--no-ablation")] = True
    seed: int = 0


@command
def render(appearance: list[Path], /, out: Out, asked: RenderOptions, json: Json = False) -> None:
    """Render a fitted skin model to radiance (OpenEXR) and an 8-bit image (PNG).

    Example: skinrig render appearance --view C03 --light L017 --calibration calibration --out
    picture --components

    Parameters
    ----------
    appearance
        APPEARANCE/ folder of a dome session with basis BRDFs; several with --bases.
    """
    from skinrig.rendering import figures
    from skinrig.rendering.request import parse_subpixels

    console = Console(json)
    if asked.exposure is not None and not asked.exposure > 0.0:
        raise UnusableError(
            f"--exposure: got {asked.exposure}, expected a factor above 0; raise it"
        )
    if len(appearance) > 1 and asked.bases is None:
        raise UsageError("appearance: got several, expected one; name one, or add --bases")
    effort = figures.RenderSettings(
        subpixels=parse_subpixels(asked.samples),
        progress=console.progress,
        **select_attributes(asked, "subsurface", "shadow_samples", "exposure", "seed"),
        **select_attributes(asked, "transport", "path_samples"),
    )
    console.progress(f"read {', '.join(str(path) for path in appearance)}")
    if asked.against is not None and not asked.components:
        _compare(appearance[0], asked.against, out, asked, console)
    elif asked.shadow_boundary:
        subject = figures.RenderModel.of(appearance[0], mesh=asked.mesh)
        _report(console, figures.draw_shadow_boundary(subject, out, effort, size_px=asked.size_px))
    else:
        _report(console, _draw(appearance, out, asked, effort))


def _compare(
    appearance: Path, session: Path, out: Path, asked: RenderOptions, console: Console
) -> None:
    """Compare renderings with photographs of a session that were held out of all fits."""
    from skinrig.rendering.photographs import errors as photographs_errors
    from skinrig.rendering.photographs import evaluation

    found = evaluation.evaluate_folders(
        appearance,
        session,
        out,
        evaluation.EvaluationSettings(
            count=asked.photographs,
            progress=console.progress,
            **select_attributes(asked, "subsurface", "ablation", "seed"),
            **select_attributes(asked, "transport", "path_samples"),
        ),
        **select_attributes(asked, "calibration", "translucency"),
    )
    photographs_errors.print_comparison(console, found)
    if not found["passed"]:
        raise typer.Exit(errors.EXIT_LIMIT_MISSED)


def _draw(
    appearance: list[Path], out: Path, asked: RenderOptions, effort: RenderSettings
) -> dict[str, Any]:
    """Render an image, a photograph with its rendering, or one image per number of lobes."""
    from skinrig.rendering import figures
    from skinrig.rendering.request import RenderRig, parse_lights

    stage = RenderRig.of(asked.rig, asked.calibration)
    camera = stage.camera(
        asked.view, size_px=asked.size_px, target_mm=asked.look_at, fov_deg=asked.fov
    )
    lights = parse_lights(
        stage,
        asked.light or (),
        radius_mm=asked.light_radius,
        environment=asked.environment,
        environment_count=asked.environment_lights,
        seed=asked.seed,
    )
    subjects = [
        figures.RenderModel.of(path, mesh=asked.mesh, translucency=asked.translucency)
        for path in appearance
    ]
    if asked.against is not None:
        name, calibration = lights[0].name, asked.calibration
        return figures.draw_photograph(
            subjects[0], asked.against, asked.view, name, out, effort, calibration=calibration
        )
    picture = figures.RenderRequest(camera, lights, out, effort, stage.assumed)
    if asked.bases is None:
        return figures.draw_rendering(subjects[0], picture, components=asked.components)
    return figures.draw_bases(subjects, _parse_ranks(asked.bases), picture)


def _parse_ranks(text: str) -> list[int]:
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) < 1 or len(set(found)) < len(found):
        raise UsageError(
            f"--bases: got {text!r}, expected different numbers of basis BRDFs; write 1,2,4, "
            "for example"
        )
    return found


def _parse_sigma_tr(row: dict[str, Any]) -> str:
    if row["sigma_tr_per_mm"] is None:
        return str(row["name"]).replace("_", " ")
    return ", ".join(f"{value:.4g}" for value in row["sigma_tr_per_mm"])


def _report(console: Console, done: dict[str, Any]) -> None:
    console.print_each("assumed", done["assumed"])
    if "bases" in done:
        for row in done["bases"]:
            gap = next(v for k, v in row.items() if k.startswith("surface_difference"))
            words = "an unknown amount: no texel is lit" if gap is None else f"{100 * gap:.1f} %"
            how = "fitted" if row["refitted"] else "reduced"
            console.print_line(
                f"{row['lobes']} basis BRDFs, {how}: specular reflection differs by {words}"
            )
    if "boundaries" in done:
        console.print_table(
            ("skin", "sigma_tr, 1/mm", "90 to 10 % red, mm", "green", "blue"),
            ((row["skin"], _parse_sigma_tr(row), *row["rise_mm"]) for row in done["boundaries"]),
        )
    console.print_line(f"{done['out']}: {', '.join(done['files'])}, {done['seconds']:.1f} s")
    console.print_document(done["schema"], {k: v for k, v in done.items() if k != "schema"})
