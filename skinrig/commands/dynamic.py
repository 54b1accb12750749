"""`skinrig fit` and `skinrig apply`: fit models of a moving face and evaluate them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from reconstruction.correspondence import landmark_table
from skinrig.command_line.help import Command, Subcommands
from skinrig.command_line.options import Json, NewMaps, choice, command
from skinrig.console import Console, select_attributes
from skinrig.errors import UsageError, require_choice
from skinrig.next_steps import shell_quote

if TYPE_CHECKING:
    from skinrig.applying.expression import AppliedExpression, ExpressionRequest, TargetFace
    from skinrig.applying.relief import ReliefEvaluator, ReliefRequest

fit_app = typer.Typer(cls=Subcommands, help="Fit models to captured data.", no_args_is_help=True)
apply_app = typer.Typer(
    cls=Subcommands, help="Evaluate fitted models of a moving face.", no_args_is_help=True
)


@fit_app.command("facial-color", cls=Command)
@command
def fit_facial_color(
    sessions: list[Path],
    /,
    out: NewMaps,
    calibration: Path | None = None,
    landmarks: Path | None = None,
    radius: float | None = None,
    stored_size: int = 256,
    json: Json = False,
) -> None:
    """Fit the hemoglobin rig: scale and bias of blood volume fraction per expression.

    The fit is deterministic.

    Example: skinrig fit facial-color session-flash --calibration calibration --out moving

    Parameters
    ----------
    sessions
        Flash sessions of one subject.
    calibration
        CALIBRATION/ folder; default: nominal values, listed as assumed.
    landmarks
        Folder with STATE.csv (name,x,y, pixels) per expression.
    radius
        Radius of the local statistics, px; default: image width / 32.
    stored_size
        Width and height of the scale and bias maps, cells.
    """
    from skinrig.fitting.facial_color import fit_facial_color as fit
    from skinrig.fitting.facial_color import summarize_states

    console = Console(json)
    found = fit(
        sessions,
        out=out,
        calibration=calibration,
        landmarks=landmarks,
        radius_px=radius,
        stored_size=stored_size,
        progress=console.progress,
    )
    rows = summarize_states(found)
    console.print_table(
        (
            "state",
            "blood volume change, points",
            "change, %",
            "median scale",
            "registration error, px",
        ),
        rows,
    )
    console.print_omissions(found.omitted)
    states = ",".join(found.hemoglobin)
    console.print_line(f"{out}: hemoglobin rig with states {states}")
    last = list(found.changes)[-1]
    console.print_line(
        f"next: skinrig apply expression {shell_quote(out)} --weights {last}=1 --out {last}"
    )
    found_values = {"states": list(found.hemoglobin), "radius_px": found.rig.radius_px}
    print_fit(
        console, "facial_color", out, found_values | {"left_out": found.omitted, "rows": rows}
    )


@fit_app.command("wrinkles", cls=Command)
@command
def fit_wrinkles(
    appearances: list[Path],
    /,
    out: NewMaps,
    mask: list[Path] | None = None,
    size_px: int = 256,
    mask_size: int = 64,
    method: Annotated[str, choice("derivatives", "differences")] = "derivatives",
    seed: int = 0,
    json: Json = False,
) -> None:
    """Fit a wrinkle map, its zones and their weights to the normals of expressions.

    Example: skinrig fit wrinkles appearance-neutral surprise=appearance-surprise --out moving

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions: the neutral face and expressions as STATE=FOLDER.
    mask
        RGBA image of four zones; give twice for eight; default: zones are estimated.
    size_px
        Width and height of the wrinkle map, texels.
    mask_size
        Width and height of estimated zone masks, texels.
    method
        Combination with the neutral normals: derivatives (two channels) or differences (of
        normals, three channels).
    seed
        Random seed of the zone estimation.
    """
    from skinrig.fitting.wrinkles import Method, list_zone_names, summarize_expressions
    from skinrig.fitting.wrinkles import fit_wrinkles as fit

    console = Console(json)
    how = require_choice("--method", method, get_args(Method))
    sizes = {"size": size_px, "mask_size": mask_size}
    found = fit(appearances, out=out, masks=mask, **sizes, seed=seed, method=how)
    console.print_table(
        ("expression", *list_zone_names(found).values()), summarize_expressions(found)
    )
    console.print_line(
        f"{out}: wrinkles explain {100 * found.fit.explained:.0f} % of normal differences"
    )
    console.print_line(
        f"mean angle to the expressions: {found.angle_deg:.3f} degrees by {how}, "
        f"{found.neutral_angle_deg:.3f} of the neutral face"
    )
    print_fit(
        console,
        "wrinkles",
        out,
        {
            "explained": found.fit.explained,
            "method": how,
            **select_attributes(found, "angle_deg", "neutral_angle_deg", "clamped_fraction"),
            "rows": summarize_expressions(found),
        },
    )


@fit_app.command("microstructure", cls=Command)
@command
def fit_microstructure(
    appearances: list[Path], /, out: NewMaps, paper_table: bool = False, json: Json = False
) -> None:
    """Fit neutral microrelief and its table of stretch kernels, per site.

    The fit is deterministic.

    Example: skinrig fit microstructure forehead=appearance-gradient --out moving

    Parameters
    ----------
    appearances
        Maps of gradient rig sessions with heights and kernels, as SITE=FOLDER.
    paper_table
        Use the published forehead table for sites with too few kernels.
    """
    from skinrig.fitting.microstructure import fit_microstructure as fit

    console = Console(json)
    found = fit(appearances, out=out, paper_table=paper_table)
    for site, one in found.items():
        low, high = one.table.stretch_range
        how = f"{one.kernels} kernels" if one.kernels else "the paper's forehead table"
        console.print_line(f"{site}: {how}, stretch {low:.2f} to {high:.2f}")
    console.print_line(f"next: skinrig view {shell_quote(out)}")
    sites = {site: one.document() for site, one in found.items()}
    print_fit(console, "microstructure", out, {"sites": sites})


@dataclass(frozen=True, slots=True)
class ReliefOptions:
    """Options of relief that follows the strain of a mesh.

    Attributes
    ----------
    size_px
        Width and height of the displacement map, pixels; default 4096, of samples 2048 (sphere),
        1000 (patch) or 1200 (face).
    relief_site
        Site whose microrelief covers the whole mesh; default: each fitted site its own region.
    synthesize
        Neutral relief: patches (measured texture, synthesized) or noise (procedural, 3D).
    extrapolate
        Outside the table's stretch range: hold (clamp to its ends) or formula.
    seed
        Random seed of the synthesized relief.
    mesoscale
        Displacement map of a scan over the mesh's texture, um, .exr or .npy; its waves above 1 mm
        are added to the relief.
    """

    size_px: int | None = None
    relief_site: str | None = None
    synthesize: Annotated[str, choice("patches", "noise")] = "patches"
    extrapolate: Annotated[str, choice("hold", "formula")] = "hold"
    seed: int = 0
    mesoscale: Path | None = None

    def relief(
        self, mesh: Path, weights: Mapping[str, float], out: Path, console: Console
    ) -> ReliefEvaluator:
        """Return the relief evaluator of a mesh and its blend shape weights."""
        from skinrig.applying.relief import ReliefEvaluator

        return ReliefEvaluator.of(mesh, weights, self.request(), out=out, progress=console.progress)

    def request(self) -> ReliefRequest:
        """Return the options as a request."""
        from skinrig.applying.relief import ReliefRequest

        given = select_attributes(self, "extrapolate", "seed", "mesoscale")
        size_px = 4096 if self.size_px is None else self.size_px
        return ReliefRequest(size_px, site=self.relief_site, source=self.synthesize, **given)


@dataclass(frozen=True, slots=True)
class ExpressionOptions:
    """Options of blood volume, color and wrinkles of an expression.

    Attributes
    ----------
    parts
        Parts to evaluate: facial_color,wrinkles,microstructure; default: all fitted.
    normalize
        Divide the weights by their sum.
    clamp
        Range of the summed weights of a wrinkle zone: unit (0 to 1) or signed (-1 to 1).
    emotional
        Scale the blood volume fraction of the whole face: up for anger, down for fear.
    gain
        Factor of the blood volume fraction.
    target_face
        Target face: APPEARANCE/ folder with hemoglobin and melanin; default: the fitted face.
    landmarks
        CSV table name,x,y: first of the fitted face, then of the target face.
    color_table
        Table of skin color, .exr or .csv (`skinrig analyse color-table`); default: linear sRGB
        under D65.
    """

    parts: str | None = None
    normalize: bool = False
    clamp: Annotated[str, choice("unit", "signed")] = "unit"
    emotional: bool = False
    gain: float = 1.0
    target_face: Path | None = None
    landmarks: list[Path] | None = None
    color_table: Path | None = None

    def expression(self, weights: Mapping[str, float]) -> ExpressionRequest:
        """Return the options as a request for an expression."""
        from skinrig.applying.expression import ExpressionRequest

        return ExpressionRequest(
            weights,
            normalize=self.normalize,
            clamp=require_choice("--clamp", self.clamp, ("unit", "signed")),
            emotional=self.emotional,
            gain=self.gain,
            target_face=_read_target_face(self.target_face, self.landmarks or []),
            color_table=self.color_table,
        )


@apply_app.command("expression", cls=Command)
@command
def apply_expression(
    appearance: Path,
    /,
    *,
    weights: str,
    out: NewMaps,
    mesh: Path | None = None,
    chosen: ExpressionOptions,
    moving: ReliefOptions,
    json: Json = False,
) -> None:
    """Evaluate blood volume, color, normals and displacement of an expression.

    Example: skinrig apply expression moving --weights smile=0.7,anger=0.3 --out expression

    Parameters
    ----------
    appearance
        Folder written by `skinrig fit`.
    weights
        Weights of expressions, with sum 1: smile=0.7,anger=0.3.
    mesh
        Mesh with blend shapes, whose strain deforms the microrelief: .npz, OBJ or glTF.
    """
    from skinrig.appearances.dynamic import DYNAMIC_PARTS
    from skinrig.applying import expression as applying
    from skinrig.capturing.option_values import parse_names

    console = Console(json)
    given = chosen.expression(applying.parse_weights(weights))
    parts = parse_names(chosen.parts) or DYNAMIC_PARTS
    relief = None
    moving.request()  # checked even where no mesh is given
    if mesh is not None:
        relief = moving.relief(mesh, applying.normalize_weights(given).weights, out, console)
    done = applying.apply_expression(
        appearance, given, out=out, parts=parts, relief=relief, progress=console.progress
    )
    _report(console, out, done)


@apply_app.command("microstructure", cls=Command)
@command
def apply_microstructure(
    appearance: Path | None = None,
    /,
    *,
    mesh: Path | None = None,
    weights: str | None = None,
    on: Annotated[str | None, choice("sphere", "patch", "face")] = None,
    out: NewMaps,
    moving: ReliefOptions,
    json: Json = False,
) -> None:
    """Synthesize the measured microrelief over a mesh and deform it by the mesh's strain.

    Example: skinrig apply microstructure moving --mesh head.npz --weights smile=1 --out relief

    Example: skinrig apply microstructure --on patch --out pushed

    Parameters
    ----------
    appearance
        Folder written by `skinrig fit`; with --on, default: a simulated forehead.
    mesh
        Mesh with blend shapes: .npz, OBJ or glTF.
    weights
        Weights of blend shapes or expressions: jawOpen=0.5,smile=1.
    on
        Draw a sample instead of a mesh: sphere (shrunk, grown, squashed), patch (a block of
        tetrahedra pushed by a probe) or face (photographs of a head's skin in expressions).
    """
    from skinrig.appearances.dynamic import MICROSTRUCTURE
    from skinrig.applying import expression as applying

    console = Console(json)
    if on is not None:
        if any(given is not None for given in (mesh, weights, moving.mesoscale)):
            raise UsageError(
                "--mesh, --weights, --mesoscale: not of a sample; remove them, or --on"
            )
        _draw_sample(on, appearance, out, moving, console)
        return
    if appearance is None or mesh is None or weights is None:
        raise UsageError(
            "appearance, --mesh, --weights: got not all three, expected them or --on; add them"
        )
    given = applying.ExpressionRequest(applying.parse_weights(weights))
    relief = moving.relief(mesh, given.weights, out, console)
    parts = (MICROSTRUCTURE,)
    done = applying.apply_expression(
        appearance, given, out=out, parts=parts, relief=relief, progress=console.progress
    )
    _report(console, out, done)


def _draw_sample(
    kind: str, appearance: Path | None, out: Path, moving: ReliefOptions, console: Console
) -> None:
    """Draw a deformed sample, and print its figures."""
    from skinrig.applying import microstructure_samples as samples

    relief = (
        samples.SampleRelief.simulated(moving.seed, samples.GROWN_PATCH_MM[kind])
        if appearance is None
        else samples.SampleRelief.fitted(appearance, moving.relief_site)
    )
    found = samples.draw_sample(
        kind, out, relief, size_px=moving.size_px, seed=moving.seed, progress=console.progress
    )
    console.print_figures({kind: found}, int, float, str)
    console.print_line(f"{out}: {', '.join(found['files'])}, sample.json")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.apply-sample/1", {"out": out, **figures})


def _read_target_face(folder: Path | None, landmarks: list[Path]) -> TargetFace | None:
    """Read the target face of a rig and both tables of landmarks; None without a folder."""
    from model import store
    from skinrig.applying.expression import TargetFace

    if folder is None:
        if landmarks:
            raise UsageError("--landmarks: applies to a target face only; add --target-face")
        return None
    if len(landmarks) not in (0, 2):
        raise UsageError(
            f"--landmarks: got {len(landmarks)} tables, expected two, of the fitted face and of "
            "the target face; give both or none"
        )
    tables = [landmark_table.read_landmark_table(path) for path in landmarks]
    own, other = tables if tables else (None, None)
    read = {"onto": folder / store.DOCUMENT_FILE}
    read |= dict(zip(("landmarks of the rig", "landmarks of the other"), landmarks, strict=False))
    found = store.read(folder)
    hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in read.items()}
    return TargetFace(found, landmarks=other, landmarks_rig=own, hashes=hashes)


def _report(console: Console, out: Path, done: AppliedExpression) -> None:
    """Print the figures and maps of an evaluation."""
    console.print_figures(done.figures, int, float, str)
    console.print_omissions(done.left_out)
    console.print_line(f"{out}: {', '.join(done.maps)}")
    document = {
        "out": out,
        "maps": list(done.maps),
        **select_attributes(done, "figures", "left_out"),
    }
    console.print_document("skinrig.apply/1", document)


def print_fit(console: Console, model: str, out: Path, found: Mapping[str, Any]) -> None:
    """Print the JSON document of a fit."""
    console.print_document("skinrig.fit/1", {"model": model, "out": out, **found})
