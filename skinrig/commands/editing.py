"""`skinrig edit` and `skinrig fit traits`: faces with other traits, and where traits come from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

from skinrig.commands.analysing import Labels
from skinrig.commands.dynamic import print_fit
from skinrig.commands.options import Json, NewMaps, Out, Seed, command, option
from skinrig.console import Console, select_attributes
from skinrig.errors import UsageError, one_of
from skinrig.next_steps import shell_quote

if TYPE_CHECKING:
    from skinrig.editing.edit import EditRequest

MerlFolder = Annotated[
    Path | None, option("Folder of MERL tables that the lobes were fitted with.")
]
LandmarkFolder = Annotated[
    Path | None, option("Folder with NAME.csv of each face; default: a simulation's own.")
]
CommonSize = Annotated[
    int | None, option("Pixels a side of the common map; default: as the textures.")
]


@dataclass(frozen=True, slots=True)
class EditOptions:
    """What is done to a face.

    Attributes
    ----------
    trait
        Amounts, joined by commas: lotion=0.6,tan=-1; 1 is all of a trait.
    space
        Traits that `skinrig fit traits` learned; default: the package's.
    region
        Where: face, beard or no-beard; of spots also skin.
    mask
        Where and how much: .png or .exr over the texture, 0 for nothing.
    spots
        freckles, moles or follicles to add, KIND=PIGMENT[:NUMBER PER CM2], or with -1 to take away:
        freckles=1:3,moles=-1.
    parts
        Of albedo,surface; default: those that a trait is known to change.
    landmarks
        Table name,x,y (texels) or name,x,y,z (mm) of the face's points.
    iterations
        Of matching the albedo's statistics.
    """

    trait: str | None = None
    space: Path | None = None
    region: str = "face"
    mask: Path | None = None
    spots: str | None = None
    parts: str | None = None
    landmarks: Path | None = None
    basis: MerlFolder = None
    iterations: int = 5
    seed: Seed = 0

    def request(self) -> EditRequest:
        """Return the edit that is asked for."""
        from skinrig.capturing.option_values import parse_amounts, parse_names
        from skinrig.editing.edit import EditRequest

        return EditRequest(
            traits=parse_amounts(_split_names(self.trait), "--trait"),
            parts=parse_names(self.parts),
            spots=parse_spots(self.spots),
            **select_attributes(self, "region", "mask", "landmarks", "basis", "iterations", "seed"),
        )


@command
def edit(appearance: Path, /, out: NewMaps, chosen: EditOptions, json: Json = False) -> None:
    """Give a face more or less of some traits, or spots; other maps stay as they are.

    Example: skinrig edit appearance-dome --trait lotion=0.6,tan=1 --out appearance-tanned

    Parameters
    ----------
    appearance
        Fitted maps of the dome.
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
    console.figures(parts, int, float)
    for one in done.record.get("spots_done", []):
        what = f"{one['drawn']} drawn" if "drawn" in one else f"{one['found']} found"
        console.say(f"{one['kind']}: {what}")
    console.each("warning", done.warnings)
    console.say(f"{out}: {', '.join(done.changed) or 'nothing'} changed")
    console.say(f"next: skinrig render {shell_quote(out)} --out pictures")
    console.document("skinrig.edit/1", {"out": out, **done.record})


@command
def fit_traits(
    appearances: list[Path],
    /,
    labels: Path,
    out: Path,
    landmarks: LandmarkFolder = None,
    vectors: str = "quantiles",
    contrast: str = "means",
    size: CommonSize = None,
    basis: MerlFolder = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Learn what traits change, from faces labelled by you.

    Example: skinrig fit traits appearance-a appearance-b --labels labels.csv --out traits.npz

    Parameters
    ----------
    appearances
        Fitted maps of the dome, a face each.
    labels
        Table name,TRAIT,...: 0 or 1 whether a face has it, or a value.
    out
        File to write, such as traits.npz.
    vectors
        What stands for an albedo: quantiles, or histograms as published.
    contrast
        means of faces with and without, or regression on all traits.
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
        vectors=one_of("--vectors", vectors, get_args(VectorKind)),
        contrast=one_of("--contrast", contrast, get_args(Contrast)),
        size=size,
        basis=basis,
        seed=seed,
        progress=console.progress,
    )
    head = ("part", "trait", "with", "without", "p value", "cosine to the true one")
    console.rows(head, found.rows)
    console.each("warning", found.warnings)
    console.each("ignored", (f"{name} has labels and was not given" for name in found.ignored))
    console.left_out(found.left_out)
    names = found.library.names
    console.say(f"{out}: {len(names)} traits of {len(found.faces)} faces")
    after = f"--space {shell_quote(out)} --trait {names[0]}=1 --out edited"
    console.say(f"next: skinrig edit APPEARANCE {after}")
    keys = ("part", "trait", "with", "without", "p_value", "expected_cosine")
    learned = {
        "faces": found.faces,
        "traits": names,
        "rows": [dict(zip(keys, row, strict=True)) for row in found.rows],
    }
    print_fit(console, "traits", out, learned | select_attributes(found, "warnings", "left_out"))


@command
def analyse_albedo(
    appearances: list[Path] | None = None,
    /,
    *,
    out: Out,
    labels: Labels = None,
    landmarks: LandmarkFolder = None,
    people: int = 87,
    size: CommonSize = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Average the color histograms of groups of faces, and tell the components they differ by.

    Example: skinrig analyse albedo appearance-a appearance-b --labels labels.csv --out analysis

    Parameters
    ----------
    appearances
        Fitted maps of the dome, a face each; none: simulated faces.
    people
        Simulated faces, of 87.
    """
    from skinrig.analysing import albedo as analysing_albedo

    console = Console(json)
    if appearances:
        found = analysing_albedo.analyze_measured(
            out,
            appearances,
            labels=labels,
            landmarks=landmarks,
            size=size,
            progress=console.progress,
        )
    elif labels is not None or landmarks is not None:
        raise UsageError("--labels, --landmarks: are of measured faces; name their folders")
    else:
        found = analysing_albedo.analyze_simulated(
            out, people=people, seed=seed, progress=console.progress
        )
    document = found.document()
    console.rows(
        ("group", "faces", "R_d red", "green", "blue"),
        [
            (group, document["groups"][group], *mean)
            for group, mean in document["mean_r_d"]["face"].items()
        ],
    )
    for region, share in found.explained.items():
        first = ", ".join(f"{100 * s:.0f} %" for s in share[:4])
        console.say(
            f"{region}: components explain {first}; "
            f"{document['components_for_90_percent'][region]} make 90 %"
        )
    console.left_out(found.left_out)
    console.say(f"{out}: {', '.join(analysing_albedo.OUTPUT_FILES)}")
    console.document("skinrig.analyse-albedo/1", {"out": out, **document})


def _split_names(text: str | None) -> list[str]:
    """Return what commas part, nothing where nothing stands."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


def parse_spots(text: str | None) -> tuple[Any, ...]:
    """Return the orders of ``KIND=AMOUNT[:DENSITY],...``.

    Examples
    --------
    >>> [(s.kind, s.amount, s.density_per_cm2) for s in parse_spots("freckles=1:3,moles=-1")]
    [('freckles', 1.0, 3.0), ('moles', -1.0, None)]
    """
    from skinrig.editing.spots import SpotOrder

    out = []
    for word in _split_names(text):
        kind, _, rest = word.partition("=")
        amount, colon, density = rest.partition(":")
        try:
            wanted = SpotOrder(kind.strip(), float(amount), float(density) if colon else None)
        except ValueError as error:
            if isinstance(error, UsageError) or type(error) is not ValueError:
                raise
            raise UsageError(
                f"--spots: got {word!r}, expected KIND=AMOUNT or KIND=AMOUNT:NUMBER PER CM2"
            ) from error
        out.append(wanted)
    return tuple(out)
