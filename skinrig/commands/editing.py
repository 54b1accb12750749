"""`skinrig edit`, `skinrig fit traits|brdf` and `skinrig analyse albedo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

from skinrig.command_line.options import Json, NewMaps, Out, Seed, choice, command, option
from skinrig.commands.analysing import Labels
from skinrig.commands.dynamic import print_fit
from skinrig.console import Console, select_attributes
from skinrig.errors import UsageError, require_choice
from skinrig.next_steps import shell_quote

if TYPE_CHECKING:
    from skinrig.editing.edit import EditRequest

MerlFolder = Annotated[
    Path | None,
    option("Folder of the tables used in the reconstruction; default: built-in materials."),
]
LandmarkFolder = Annotated[
    Path | None,
    option("Folder with NAME.csv (name,x,y, texels) per face; default: the simulation's own."),
]
CommonSize = Annotated[
    int | None,
    option("Width and height of the common map, texels; default: those of the textures."),
]


@dataclass(frozen=True, slots=True)
class EditOptions:
    """Options of an edit.

    Attributes
    ----------
    trait
        Amounts of traits, separated by commas: lotion=0.6,tan=-1; 1 is the full trait.
    space
        Trait library written by `skinrig fit traits`; default: the built-in library.
    region
        Edited region; skin (face without eyes, brows and lips) for --spots only.
    mask
        Weight of the edit per texel, 0 to 1: .png or .exr with the texture's aspect ratio; default:
        1 in the region.
    spots
        Spots to add as KIND=PIGMENT[:NUMBER PER CM2], or to remove as KIND=-1; KIND is freckles,
        moles or follicles: freckles=1:3,moles=-1.
    parts
        Parts to edit: albedo,surface; default: those with a significant effect of the trait.
    landmarks
        CSV table name,x,y (texels) or name,x,y,z (mm) of the face's landmarks.
    iterations
        Iterations of the albedo histogram matching.
    """

    trait: str | None = None
    space: Path | None = None
    region: Annotated[str, choice("face", "beard", "no-beard", "skin")] = "face"
    mask: Path | None = None
    spots: str | None = None
    parts: str | None = None
    landmarks: Path | None = None
    merl_basis: MerlFolder = None
    iterations: int = 5
    seed: Seed = 0

    def request(self) -> EditRequest:
        """Return the options as a request for an edit."""
        from skinrig.capturing.option_values import parse_amounts, parse_names
        from skinrig.editing.edit import EditRequest

        return EditRequest(
            traits=parse_amounts(_split_names(self.trait), "--trait"),
            parts=parse_names(self.parts),
            spots=parse_spots(self.spots),
            basis=self.merl_basis,
            **select_attributes(self, "region", "mask", "landmarks", "iterations", "seed"),
        )


@command
def edit(appearance: Path, /, out: NewMaps, chosen: EditOptions, json: Json = False) -> None:
    """Change the traits or spots of a face; all other maps stay unchanged.

    Example: skinrig edit appearance-dome --trait lotion=0.6,tan=1 --out appearance-tanned

    Parameters
    ----------
    appearance
        APPEARANCE/ folder of a dome session.
    """
    from skinrig.editing import edit as editing
    from skinrig.traits import regions

    console = Console(json)
    order = chosen.request()
    library, digest = regions.load(chosen.space) if order.traits else (None, "")
    done = editing.edit_folder(
        appearance, order, out=out, library=library, library_hash=digest, progress=console.progress
    )
    parts = {part: done.record.get(part, {}) for part in editing.EDITABLE_PARTS}
    console.print_figures(parts, int, float)
    for one in done.record.get("spots_done", []):
        what = f"{one['drawn']} drawn" if "drawn" in one else f"{one['found']} found"
        console.print_line(f"{one['kind']}: {what}")
    console.print_each("warning", done.warnings)
    console.print_line(f"{out}: {', '.join(done.changed) or 'nothing'} changed")
    console.print_line(f"next: skinrig render {shell_quote(out)} --out pictures")
    console.print_document("skinrig.edit/1", {"out": out, **done.record})


@command
def fit_traits(
    appearances: list[Path],
    /,
    labels: Path,
    out: Path,
    landmarks: LandmarkFolder = None,
    vectors: Annotated[str, choice("quantiles", "histograms")] = "quantiles",
    contrast: Annotated[str, choice("means", "regression")] = "means",
    size_px: CommonSize = None,
    merl_basis: MerlFolder = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Learn the effect of traits on skin from labeled faces.

    Example: skinrig fit traits appearance-a appearance-b --labels labels.csv --out traits.npz

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions, one per face.
    labels
        CSV table name,TRAIT,... with 0, 1 or a value, one row per face.
    out
        File to write, such as traits.npz.
    vectors
        Feature vector of an albedo: quantiles, or histograms (as published).
    contrast
        Effect of a trait: means (with minus without) or regression (on all traits).
    """
    from model.traits.vectors import Contrast
    from skinrig.fitting.traits import fit_traits as fit
    from skinrig.traits.albedo_vectors import VectorKind

    console = Console(json)
    found = fit(
        appearances,
        labels,
        out=out,
        landmarks=landmarks,
        vectors=require_choice("--vectors", vectors, get_args(VectorKind)),
        contrast=require_choice("--contrast", contrast, get_args(Contrast)),
        size=size_px,
        basis=merl_basis,
        seed=seed,
        progress=console.progress,
    )
    head = ("part", "trait", "with", "without", "p value", "cosine to the true one")
    console.print_table(head, found.rows)
    console.print_each("warning", found.warnings)
    console.print_each(
        "ignored", (f"{name} has labels but is not an input" for name in found.ignored)
    )
    console.print_omissions(found.left_out)
    names = found.library.names
    console.print_line(f"{out}: {len(names)} traits of {len(found.faces)} faces")
    after = f"--space {shell_quote(out)} --trait {names[0]}=1 --out edited"
    console.print_line(f"next: skinrig edit {shell_quote(appearances[0])} {after}")
    keys = ("part", "trait", "with", "without", "p_value", "expected_cosine")
    learned = {
        "faces": found.faces,
        "traits": names,
        "rows": [dict(zip(keys, row, strict=True)) for row in found.rows],
    }
    print_fit(console, "traits", out, learned | select_attributes(found, "warnings", "left_out"))


@command
def fit_brdf(
    tables: Path | None = None, /, *, out: Out, count: int = 100, seed: Seed = 0, json: Json = False
) -> None:
    """Fit measured BRDF tables by formulas and by other tables, and judge grids that store them.

    Errors are relative to the RMS of each BRDF, those of held-out samples to the RMS of BRDF x
    cosine of the light. `skinrig reconstruct --merl-basis` fits sessions with the same folder of
    tables.

    Example: skinrig fit brdf merl-tables --out tables

    Parameters
    ----------
    tables
        Folder of MERL (.binary) and RGL (.bsdf) files; default: generated tables.
    count
        Number of generated tables.
    seed
        Random seed of generated tables, samples and noise.
    """
    from skinrig.fitting import brdf_tables

    console = Console(json)
    found = brdf_tables.fit_tables(out, tables, count=count, seed=seed, progress=console.progress)

    def percents(errors: dict[str, float]) -> list[str]:
        return [f"{100.0 * error:.2f} %" for error in errors.values()]

    console.print_table(
        ("materials of the fit", "whole table, 50 %", "90 %", "held-out samples, 50 %", "90 %"),
        (
            (who, *percents(errors), *percents(found["fit_error"][who]))
            for who, errors in found["mixture_error"].items()
        ),
    )
    console.print_table(
        ("grid", "coefficients", "BRDF, 50 %", "90 %", "cube root, 50 %", "90 %"),
        (
            (
                brdf_tables.GRID_LABELS[row["grid"]],
                row["coefficients"],
                *percents(row["error"]),
                *percents(row["cube_root_error"]),
            )
            for row in found["grids"]
        ),
    )
    console.print_line(f"{found['tables']} tables, {found['fits']} of them fitted from samples")
    console.print_line(f"{out}: {', '.join(brdf_tables.OUTPUT_FILES)}")
    print_fit(console, "brdf", out, {k: v for k, v in found.items() if k != "schema"})


@command
def analyse_albedo(
    appearances: list[Path] | None = None,
    /,
    *,
    out: Out,
    labels: Labels = None,
    landmarks: LandmarkFolder = None,
    people: int | None = None,
    size_px: CommonSize = None,
    seed: Annotated[int | None, option("Random seed of --people; default: 0.")] = None,
    json: Json = False,
) -> None:
    """Average color histograms of groups of faces and compute their principal components.

    Example: skinrig analyse albedo appearance-a appearance-b --labels labels.csv --out analysis

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions, one per face; none: packaged sessions of simulated
        faces.
    people
        Number of simulated faces. Default: all.
    """
    from skinrig.analysing import albedo as analysing_albedo

    console = Console(json)
    if appearances:
        if people is not None or seed is not None:
            raise UsageError(
                "--people, --seed: apply to simulated faces only; omit them or the folders"
            )
        found = analysing_albedo.analyze_measured(
            out,
            appearances,
            labels=labels,
            landmarks=landmarks,
            size=size_px,
            progress=console.progress,
        )
    elif (labels, landmarks, size_px) != (None, None, None):
        raise UsageError(
            "--labels, --landmarks, --size-px: apply to measured faces only; name APPEARANCE/ "
            "folders"
        )
    elif people is None and seed is not None:
        raise UsageError("--seed: has no effect without --people; add it or omit --seed")
    else:
        found = analysing_albedo.analyze_simulated(out, people=people, seed=seed or 0)
    document = found.document()
    console.print_table(
        ("group", "faces", "R_d red", "green", "blue"),
        [
            (group, document["groups"][group], *mean)
            for group, mean in document["mean_r_d"]["face"].items()
        ],
    )
    for region, share in found.explained.items():
        first = ", ".join(f"{100 * s:.0f} %" for s in share[:4])
        console.print_line(
            f"{region}: components explain {first} of the variance; "
            f"{document['components_for_90_percent'][region]} explain 90 %"
        )
    console.print_omissions(found.left_out)
    console.print_line(f"{out}: {', '.join(analysing_albedo.OUTPUT_FILES)}")
    console.print_document("skinrig.analyse-albedo/1", {"out": out, **document})


def _split_names(text: str | None) -> list[str]:
    """Split a list separated by commas; empty names are dropped."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


def parse_spots(text: str | None) -> tuple[Any, ...]:
    """Parse spots to add or remove from ``KIND=AMOUNT[:DENSITY],...``.

    Examples
    --------
    >>> [(s.kind, s.amount, s.density_per_cm2) for s in parse_spots("freckles=1:3,moles=-1")]
    [('freckles', 1.0, 3.0), ('moles', -1.0, None)]
    """
    from skinrig.editing.spots import SpotRequest

    out = []
    for word in _split_names(text):
        kind, _, rest = word.partition("=")
        amount, colon, density = rest.partition(":")
        try:
            wanted = SpotRequest(kind.strip(), float(amount), float(density) if colon else None)
        except ValueError as error:
            if isinstance(error, UsageError) or type(error) is not ValueError:
                raise
            raise UsageError(
                f"--spots: got {word!r}, expected KIND=AMOUNT or KIND=AMOUNT:NUMBER PER CM2; "
                "write freckles=1:3, for example"
            ) from error
        out.append(wanted)
    return tuple(out)
