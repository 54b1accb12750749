"""`skinrig edit` and `skinrig fit traits`: faces with other traits, and where traits come from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skinrig.commands.options import Json, NewMaps, Seed
from skinrig.console import Console
from skinrig.errors import UnusableError, UsageError
from skinrig.next_steps import shell_quote


def edit(
    appearance: Annotated[Path, typer.Argument(help="Fitted maps of the dome.")],
    out: NewMaps,
    trait: Annotated[
        str | None,
        typer.Option(help="Amounts, joined by commas: lotion=0.6,tan=-1; 1 is all of a trait."),
    ] = None,
    space: Annotated[
        Path | None,
        typer.Option(help="Traits that `skinrig fit traits` learned; default: the package's."),
    ] = None,
    region: Annotated[
        str, typer.Option(help="Where: face, beard or no-beard; of spots also skin.")
    ] = "face",
    mask: Annotated[
        Path | None,
        typer.Option(help="Where and how much: .png or .exr over the texture, 0 for nothing."),
    ] = None,
    spots: Annotated[
        str | None,
        typer.Option(
            help="freckles, moles or follicles to add, KIND=PIGMENT[:NUMBER PER CM2], or with -1 "
            "to take away: freckles=1:3,moles=-1."
        ),
    ] = None,
    parts: Annotated[
        str | None,
        typer.Option(help="Of albedo,surface; default: those that a trait is known to change."),
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="Table name,x,y (texels) or name,x,y,z (mm) of the face's points."),
    ] = None,
    basis: Annotated[
        Path | None, typer.Option(help="Folder of MERL tables that the lobes were fitted with.")
    ] = None,
    iterations: Annotated[int, typer.Option(help="Of matching the albedo's statistics.")] = 5,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Give a face more or less of some traits, or spots; other maps stay as they are.

    Example: skinrig edit appearance-dome --trait lotion=0.6,tan=1 --out appearance-tanned
    """
    from skinrig.editing import edit as editing
    from skinrig.traits import regions

    console = Console(json)
    order = editing.EditRequest(
        traits=parse_amounts("--trait", trait),
        region=region,
        parts=None if parts is None else tuple(p.strip() for p in parts.split(",")),
        mask=mask,
        spots=parse_spots(spots),
        landmarks=landmarks,
        basis=basis,
        iterations=iterations,
        seed=seed,
    )
    library, digest = regions.load(space) if order.traits else (None, "")
    done = editing.edit(
        appearance, order, out=out, library=library, library_hash=digest, progress=console.progress
    )
    rows = [
        (part, key, value)
        for part in editing.EDITABLE_PARTS
        for key, value in done.record.get(part, {}).items()
        if isinstance(value, int | float)
    ]
    if rows:
        console.rows(("part", "figure", "value"), rows)
    for one in done.record.get("spots_done", []):
        what = f"{one['drawn']} drawn" if "drawn" in one else f"{one['found']} found"
        console.say(f"{one['kind']}: {what}")
    for text in done.warnings:
        console.say(f"warning: {text}")
    console.say(f"{out}: {', '.join(done.changed) or 'nothing'} changed")
    console.say(f"next: skinrig render {shell_quote(out)} --out pictures")
    console.document("skinrig.edit/1", {"out": out, **done.record})


def fit_traits(
    appearances: Annotated[
        list[Path], typer.Argument(help="Fitted maps of the dome, a face each.")
    ],
    labels: Annotated[
        Path, typer.Option(help="Table name,TRAIT,...: 0 or 1 whether a face has it, or a value.")
    ],
    out: Annotated[Path, typer.Option("--out", help="File to write, such as traits.npz.")],
    landmarks: Annotated[
        Path | None,
        typer.Option(help="Folder with NAME.csv of each face; default: a simulation's own."),
    ] = None,
    vectors: Annotated[
        str, typer.Option(help="What stands for an albedo: quantiles, or histograms as published.")
    ] = "quantiles",
    contrast: Annotated[
        str, typer.Option(help="means of faces with and without, or regression on all traits.")
    ] = "means",
    size: Annotated[
        int | None, typer.Option(help="Pixels a side of the common map; default: as the textures.")
    ] = None,
    basis: Annotated[
        Path | None, typer.Option(help="Folder of MERL tables that the lobes were fitted with.")
    ] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Learn what traits change, from faces labelled by you.

    Example: skinrig fit traits appearance-a appearance-b --labels labels.csv --out traits.npz
    """
    from skinrig.fitting.traits import fit_traits as fit

    console = Console(json)
    one_of("--vectors", vectors, ("quantiles", "histograms"))
    one_of("--contrast", contrast, ("means", "regression"))
    found = fit(
        appearances,
        labels,
        out=out,
        landmarks=landmarks,
        vectors=vectors,  # type: ignore[arg-type]
        contrast=contrast,  # type: ignore[arg-type]
        size=size,
        basis=basis,
        seed=seed,
        progress=console.progress,
    )
    head = ("part", "trait", "with", "without", "p value", "cosine to the true one")
    console.rows(head, found.rows)
    for text in found.warnings:
        console.say(f"warning: {text}")
    for name in found.ignored:
        console.say(f"ignored: {name} has labels and was not given")
    for what, why in found.left_out:
        console.say(f"left out: {what}: {why}")
    names = found.library.names
    console.say(f"{out}: {len(names)} traits of {len(found.faces)} faces")
    first = names[0]
    console.say(
        f"next: skinrig edit APPEARANCE --space {shell_quote(out)} --trait {first}=1 --out edited"
    )
    console.document(
        "skinrig.fit/1",
        {
            "model": "traits",
            "out": out,
            "faces": found.faces,
            "traits": names,
            "rows": [
                dict(
                    zip(
                        ("part", "trait", "with", "without", "p_value", "expected_cosine"),
                        row,
                        strict=True,
                    )
                )
                for row in found.rows
            ],
            "warnings": found.warnings,
            "left_out": [list(row) for row in found.left_out],
        },
    )


def analyse_albedo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")],
    appearances: Annotated[
        list[Path] | None,
        typer.Argument(help="Fitted maps of the dome, a face each; none: simulated faces."),
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="Table name,TRAIT,... of 0 and 1, a line for each face.")
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="Folder with NAME.csv of each face; default: a simulation's own."),
    ] = None,
    people: Annotated[int, typer.Option(help="Simulated faces, of 87.")] = 87,
    size: Annotated[
        int | None, typer.Option(help="Pixels a side of the common map; default: as the textures.")
    ] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Average the color histograms of groups of faces, and tell the components they differ by.

    Example: skinrig analyse albedo appearance-a appearance-b --labels labels.csv --out analysis
    """
    from skinrig.analysing import albedo as analysing_albedo

    console = Console(json)
    if appearances:
        found = analysing_albedo.analyse_measured(
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
        found = analysing_albedo.analyse_simulated(
            out, people=people, seed=seed, progress=console.progress
        )
    told = found.document()
    console.rows(
        ("group", "faces", "R_d red", "green", "blue"),
        [(group, told["groups"][group], *mean) for group, mean in told["mean_r_d"]["face"].items()],
    )
    for region, share in found.explained.items():
        first = ", ".join(f"{100 * s:.0f} %" for s in share[:4])
        console.say(
            f"{region}: components explain {first}; "
            f"{told['components_for_90_percent'][region]} make 90 %"
        )
    for what, why in found.left_out:
        console.say(f"left out: {what}: {why}")
    console.say(f"{out}: {', '.join(analysing_albedo.OUTPUT_FILES)}")
    console.document("skinrig.analyse-albedo/1", {"out": out, **told})


def parse_amounts(option: str, text: str | None) -> dict[str, float]:
    """Return names and numbers of ``NAME=NUMBER,...``.

    Raises
    ------
    UsageError
        For another form, and a name given twice.

    Examples
    --------
    >>> parse_amounts("--trait", "lotion=0.6, tan=-1")
    {'lotion': 0.6, 'tan': -1.0}
    """
    out: dict[str, float] = {}
    for word in filter(None, (w.strip() for w in (text or "").split(","))):
        name, equals, value = (part.strip() for part in word.partition("="))
        try:
            number = float(value)
        except ValueError:
            equals = ""
            number = 0.0
        if not equals or not name or name in out:
            raise UsageError(f"{option}: got {word!r}, expected NAME=NUMBER, each name once")
        out[name] = number
    return out


def parse_spots(text: str | None) -> tuple[Any, ...]:
    """Return the orders of ``KIND=AMOUNT[:DENSITY],...``.

    Examples
    --------
    >>> [(s.kind, s.amount, s.density_per_cm2) for s in parse_spots("freckles=1:3,moles=-1")]
    [('freckles', 1.0, 3.0), ('moles', -1.0, None)]
    """
    from skinrig.editing.spots import SpotOrder

    out = []
    for word in filter(None, (w.strip() for w in (text or "").split(","))):
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


def one_of(option: str, given: str, allowed: tuple[str, ...]) -> None:
    """Raise `UnusableError` for a word that an option does not know."""
    if given not in allowed:
        raise UnusableError(f"{option}: got {given!r}, expected {' or '.join(allowed)}")
