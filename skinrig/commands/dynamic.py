"""`skinrig fit` and `skinrig apply`: models of a moving face, fitted and evaluated."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reconstruction.correspondence import landmark_table
from skinrig.commands.help import Command, Subcommands
from skinrig.commands.options import Json, NewMaps, command
from skinrig.console import Console, select_attributes
from skinrig.errors import UsageError, one_of
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
    """Fit the hemoglobin rig: blood of each state as scale and bias of the neutral.

    Nothing is left to chance: there is no --seed.

    Example: skinrig fit facial-color session-flash --calibration calibration --out moving

    Parameters
    ----------
    sessions
        Flash sessions of one subject.
    calibration
        CALIBRATION/ folder.
    landmarks
        Folder with STATE.csv (name,x,y) for each state.
    radius
        Radius of the local statistics, px; default: side / 32.
    stored_size
        Cells a side of scale and bias maps.
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
    console.rows(
        ("state", "change of blood, points", "change, %", "median scale", "place error, px"), rows
    )
    console.left_out(found.omitted)
    states = ",".join(found.hemoglobin)
    console.say(f"{out}: hemoglobin rig of {states}")
    last = list(found.changes)[-1]
    console.say(
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
    size: int = 256,
    mask_size: int = 64,
    seed: int = 0,
    json: Json = False,
) -> None:
    """Fit a wrinkle map, its zones and their weights to normals of expressions.

    Example: skinrig fit wrinkles appearance-neutral surprise=appearance-surprise --out moving

    Parameters
    ----------
    appearances
        Maps of dome sessions: neutral and expressions.
    mask
        RGBA picture of four zones; twice for eight.
    size
        Texels a side of the wrinkle map.
    mask_size
        Texels a side of masks that are found.
    seed
        Seed of the search for zones.
    """
    from skinrig.fitting.wrinkles import fit_wrinkles as fit
    from skinrig.fitting.wrinkles import summarize_expressions, zone_names

    console = Console(json)
    found = fit(appearances, out=out, masks=mask, size=size, mask_size=mask_size, seed=seed)
    console.rows(("expression", *zone_names(found).values()), summarize_expressions(found))
    console.say(f"{out}: wrinkles explain {100 * found.fit.explained:.0f} % of the differences")
    print_fit(
        console,
        "wrinkles",
        out,
        {"explained": found.fit.explained, "rows": summarize_expressions(found)},
    )


@fit_app.command("microstructure", cls=Command)
@command
def fit_microstructure(
    appearances: list[Path], /, out: NewMaps, paper_table: bool = False, json: Json = False
) -> None:
    """Fit neutral microrelief and its table of kernels, site by site.

    Nothing is left to chance: there is no --seed.

    Example: skinrig fit microstructure forehead=appearance-gradient --out moving

    Parameters
    ----------
    appearances
        Maps of caliper sessions with heights and kernels.
    paper_table
        The paper's forehead where kernels are too few.
    """
    from skinrig.fitting.microstructure import fit_microstructure as fit

    console = Console(json)
    found = fit(appearances, out=out, paper_table=paper_table)
    for site, one in found.items():
        low, high = one.table.stretch_range
        how = f"{one.kernels} kernels" if one.kernels else "the paper's forehead table"
        console.say(f"{site}: {how}, stretch {low:.2f} to {high:.2f}")
    console.say(
        f"next: skinrig apply microstructure {shell_quote(out)} --mesh MESH --weights SHAPE=1 "
        "--out DIR"
    )
    sites = {site: one.document() for site, one in found.items()}
    print_fit(console, "microstructure", out, {"sites": sites})


@dataclass(frozen=True, slots=True)
class ReliefOptions:
    """Options of the relief that moves with a mesh.

    Attributes
    ----------
    size
        Pixels a side of the displacement map.
    site
        Whose microrelief; default: the first.
    synthesize
        Neutral relief: patches (measured ones, grown) or noise (in space).
    extrapolate
        Beyond the table's stretch range: hold its ends, or formula.
    seed
        Seed of the grown relief.
    """

    size: int = 4096
    site: str | None = None
    synthesize: str = "patches"
    extrapolate: str = "hold"
    seed: int = 0

    def relief(
        self, mesh: Path, weights: Mapping[str, float], out: Path, console: Console
    ) -> ReliefEvaluator:
        """Return what evaluates the relief on a mesh under weights of its shapes."""
        from skinrig.applying.relief import ReliefEvaluator

        return ReliefEvaluator.of(mesh, weights, self.request(), out=out, progress=console.progress)

    def request(self) -> ReliefRequest:
        """Return the relief that is asked for."""
        from skinrig.applying.relief import ReliefRequest

        given = select_attributes(self, "site", "extrapolate", "seed")
        return ReliefRequest(size_px=self.size, source=self.synthesize, **given)


@dataclass(frozen=True, slots=True)
class ExpressionOptions:
    """Options of blood, color and wrinkles of an expression.

    Attributes
    ----------
    parts
        Of facial_color,wrinkles,microstructure; default: all.
    normalize
        Divide the weights by their sum.
    clamp
        Range of a wrinkle zone's sum: unit is 0...1, signed -1...1.
    emotional
        Anger reddens, fear pales the whole face.
    gain
        One more factor of all blood.
    onto
        Maps of another face (hemoglobin, melanin) that the rig is applied to.
    landmarks
        Table name,x,y of the rig's face; a second one of the other face.
    """

    parts: str | None = None
    normalize: bool = False
    clamp: str = "unit"
    emotional: bool = False
    gain: float = 1.0
    onto: Path | None = None
    landmarks: list[Path] | None = None

    def expression(self, weights: Mapping[str, float]) -> ExpressionRequest:
        """Return the expression that is asked for."""
        from skinrig.applying.expression import ExpressionRequest

        return ExpressionRequest(
            weights,
            normalize=self.normalize,
            clamp=one_of("--clamp", self.clamp, ("unit", "signed")),
            emotional=self.emotional,
            gain=self.gain,
            onto=_read_target_face(self.onto, self.landmarks or []),
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
    """Evaluate blood, color, normals and displacement of an expression.

    Example: skinrig apply expression moving --weights smile=0.7,anger=0.3 --out expression

    Parameters
    ----------
    appearance
        Folder that `skinrig fit` made.
    weights
        States and their weights: smile=0.7,anger=0.3; they sum to one.
    mesh
        Mesh with blend shapes: .npz, OBJ or glTF; strain comes from it.
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
    appearance: Path,
    /,
    mesh: Path,
    weights: str,
    out: NewMaps,
    moving: ReliefOptions,
    json: Json = False,
) -> None:
    """Grow the measured relief over a mesh and let it follow the mesh's strain.

    Example: skinrig apply microstructure moving --mesh head.npz --weights smile=1 --out relief

    Parameters
    ----------
    appearance
        Folder that `skinrig fit` made.
    mesh
        Mesh with blend shapes: .npz, OBJ or glTF.
    weights
        Blend shapes or states: jawOpen=0.5,smile=1.
    """
    from skinrig.appearances.dynamic import MICROSTRUCTURE
    from skinrig.applying import expression as applying

    console = Console(json)
    given = applying.ExpressionRequest(applying.parse_weights(weights))
    relief = moving.relief(mesh, given.weights, out, console)
    parts = (MICROSTRUCTURE,)
    done = applying.apply_expression(
        appearance, given, out=out, parts=parts, relief=relief, progress=console.progress
    )
    _report(console, out, done)


def _read_target_face(onto: Path | None, landmarks: list[Path]) -> TargetFace | None:
    """Return the face that a rig is applied to, with its landmarks."""
    from model import store
    from skinrig.applying.expression import TargetFace

    if onto is None:
        if landmarks:
            raise UsageError("--landmarks: is for --onto, another face, which is not given")
        return None
    if len(landmarks) not in (0, 2):
        raise UsageError(
            f"--landmarks: got {len(landmarks)} tables, expected two, of the rig's face and of the "
            "other, or none"
        )
    tables = [landmark_table.read_landmark_table(path) for path in landmarks]
    own, other = tables if tables else (None, None)
    read = {"onto": onto / store.DOCUMENT_FILE}
    read |= dict(zip(("landmarks of the rig", "landmarks of the other"), landmarks, strict=False))
    found = store.read(onto)
    hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in read.items()}
    return TargetFace(found, landmarks=other, landmarks_rig=own, hashes=hashes)


def _report(console: Console, out: Path, done: AppliedExpression) -> None:
    """Print what an evaluation made."""
    console.figures(done.figures, int, float, str)
    console.left_out(done.left_out)
    console.say(f"{out}: {', '.join(done.maps)}")
    document = {
        "out": out,
        "maps": list(done.maps),
        **select_attributes(done, "figures", "left_out"),
    }
    console.document("skinrig.apply/1", document)


def print_fit(console: Console, model: str, out: Path, found: Mapping[str, Any]) -> None:
    """Print the document of a fit."""
    console.document("skinrig.fit/1", {"model": model, "out": out, **found})


@fit_app.command("reflectance", cls=Command)
@command
def fit_reflectance(
    dome: Path,
    probe: Path | None = None,
    /,
    *,
    out: NewMaps,
    landmarks: Annotated[Path | None, typer.Option("--landmarks", "--sites")] = None,
    json: Json = False,
) -> None:
    """Put lobes, albedo, normals and translucency of a subject together as one model.

    Example: skinrig fit reflectance appearance-dome appearance-probe --out model

    Parameters
    ----------
    dome
        Maps of a dome session: normals, r_d, lobes.
    probe
        Maps of a fibre probe session on the same subject.
    landmarks
        Table name,x,y of the probe's sites in texels of the dome's maps.
    """
    from skinrig.fitting.reflectance import fit_reflectance as fit
    from skinrig.fitting.reflectance import summarize_medians

    console = Console(json)
    found = fit(dome, probe, out=out, landmarks=landmarks)
    rows = summarize_medians(found)
    console.rows(("median over valid texels", "red", "green", "blue"), rows)
    for site in found.placed.sites if found.placed is not None else ():
        console.say(f"{site.name}: texel row {site.texel[0]}, column {site.texel[1]}")
    console.each("assumed", found.assumed)
    console.left_out(found.left_out)
    valid = float(found.model.valid.mean())
    console.say(f"{out}: reflectance model, {100 * valid:.0f} % of its texels valid")
    console.say(f"next: skinrig render {shell_quote(out)} --light 1,1,2 --out picture")
    print_fit(
        console,
        "reflectance",
        out,
        select_attributes(found, "assumed", "left_out") | {"rows": rows},
    )
