"""`skinrig render`: pictures of a fitted skin model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from skinrig import errors
from skinrig.commands.options import Json, Out, command
from skinrig.console import Console, select_attributes
from skinrig.errors import UnusableError, UsageError

if TYPE_CHECKING:
    from skinrig.rendering.figures import RenderSettings


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """What is seen, under which light, how much is computed, and which pictures are made.

    Attributes
    ----------
    view
        View of the rig, such as C03, or the camera's place in mm: 0,0,700.
    light
        Light of the rig (L017), direction towards it (1,1,2) or place in mm (at:300,200,600), with
        *FACTOR or *R,G,B for its intensity; repeatable.
    environment
        Light from everywhere: latitude-longitude OpenEXR map.
    environment_lights
        Lights that are drawn from the environment.
    mesh
        Another mesh with the maps' texture coordinates: OBJ, PLY or .npz.
    rig
        Rig whose views and lights are named.
    calibration
        CALIBRATION/ folder; default: the rig as drawn.
    size
        Columns of the picture.
    fov
        Of a camera given by its place: degrees across.
    target
        What that camera looks at, mm.
    samples
        Rays a pixel: 1, 4, 9, 16 ...
    shadow_samples
        Points of each light's disc that a ray looks for.
    light_radius
        Of lights' discs, mm (far ones at 700 mm); default: the rig's, 10.
    subsurface
        dipole: light spreads in skin; local: it leaves where it entered; none: the surface alone.
    translucency
        sigma_tr of red, green, blue everywhere, 1/mm: 0.3558,0.7932,1.5173.
    components
        Light from inside and surface apart, too.
    bases
        Compare numbers of lobes: 1,2,4; more than were fitted cannot be had.
    exposure
        Factor of the PNGs; default: skin is shown well.
    against
        Session whose photographs the model was not fitted to (reconstruct --hold-out): render what
        they show, and compare; with --components take the photograph of --view and --light apart.
    photographs
        With --against: most photographs, even over those held out.
    seed
        Of the environment's lights, and of --bases.
    shadow_boundary
        A card's shadow on the forehead and on a flat patch, by least and greatest sigma_tr; brings
        its own view and light.
    ablation
        With --against: also compare without each part of the model.
    """

    view: str = "0,0,700"
    light: list[str] | None = None
    environment: Path | None = None
    environment_lights: int = 64
    mesh: Path | None = None
    rig: str = "dome"
    calibration: Path | None = None
    size: int = 512
    fov: float = 25.0
    target: str = "0,0,0"
    samples: int = 4
    shadow_samples: int = 4
    light_radius: float | None = None
    subsurface: str = "dipole"
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
    """Render a fitted skin model: radiance as OpenEXR, and a picture of it.

    Example: skinrig render appearance --view C03 --light L017 --calibration calibration --out
    picture --components

    Parameters
    ----------
    appearance
        Fitted maps of the dome, with lobes; several for --bases.
    """
    from skinrig.rendering import figures
    from skinrig.rendering.render import Subsurface
    from skinrig.rendering.request import parse_subpixels

    console = Console(json)
    if asked.subsurface not in get_args(Subsurface):
        raise UnusableError(
            f"--subsurface: got {asked.subsurface!r}, expected {', '.join(get_args(Subsurface))}"
        )
    if asked.exposure is not None and not asked.exposure > 0.0:
        raise UnusableError(f"--exposure: got {asked.exposure}, expected a factor above 0")
    if len(appearance) > 1 and asked.bases is None:
        raise UsageError("appearance: got several, expected one; several are for --bases")
    effort = figures.RenderSettings(
        subpixels=parse_subpixels(asked.samples),
        progress=console.progress,
        **select_attributes(asked, "subsurface", "shadow_samples", "exposure", "seed"),
    )
    console.progress(f"read {', '.join(str(path) for path in appearance)}")
    if asked.against is not None and not asked.components:
        _compare(appearance[0], asked.against, out, asked, console)
    elif asked.shadow_boundary:
        subject = figures.RenderModel.of(appearance[0], mesh=asked.mesh)
        _report(console, figures.draw_shadow_boundary(subject, out, effort, size_px=asked.size))
    else:
        _report(console, _draw(appearance, out, asked, effort))


def _compare(
    appearance: Path, session: Path, out: Path, asked: RenderOptions, console: Console
) -> None:
    """Compare renderings with photographs of a session that no fit has seen."""
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
        ),
        **select_attributes(asked, "calibration", "translucency"),
    )
    photographs_errors.print_comparison(console, found)
    if not found["passed"]:
        raise typer.Exit(errors.LIMIT_MISSED)


def _draw(
    appearance: list[Path], out: Path, asked: RenderOptions, effort: RenderSettings
) -> dict[str, Any]:
    """Draw a picture, a photograph beside its rendering, or one for each number of lobes."""
    from skinrig.rendering import figures
    from skinrig.rendering.request import RenderRig, parse_lights

    stage = RenderRig.of(asked.rig, asked.calibration)
    camera = stage.camera(asked.view, size_px=asked.size, target_mm=asked.target, fov_deg=asked.fov)
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
        raise UsageError(f"--bases: got {text!r}, expected numbers of lobes that differ, as 1,2,4")
    return found


def _parse_sigma_tr(row: dict[str, Any]) -> str:
    if row["sigma_tr_per_mm"] is None:
        return str(row["name"]).replace("_", " ")
    return ", ".join(f"{value:.4g}" for value in row["sigma_tr_per_mm"])


def _report(console: Console, done: dict[str, Any]) -> None:
    console.each("assumed", done["assumed"])
    if "bases" in done:
        for row in done["bases"]:
            gap = next(v for k, v in row.items() if k.startswith("surface_difference"))
            words = "nothing is lit" if gap is None else f"{100 * gap:.1f} %"
            how = "fitted" if row["refitted"] else "reduced"
            console.say(f"{row['lobes']} lobes, {how}: surface reflection differs by {words}")
    if "boundaries" in done:
        console.rows(
            ("skin", "sigma_tr, 1/mm", "90 to 10 % red, mm", "green", "blue"),
            ((row["skin"], _parse_sigma_tr(row), *row["rise_mm"]) for row in done["boundaries"]),
        )
    console.say(f"{done['out']}: {', '.join(done['files'])}, {done['seconds']:.1f} s")
    console.document(done["schema"], {k: v for k, v in done.items() if k != "schema"})
