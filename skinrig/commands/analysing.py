"""`skinrig analyse`: statistics over the fitted maps of several faces."""

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from skinrig.command_line.help import Command, Subcommands
from skinrig.command_line.options import Json, Out, choice, command, option
from skinrig.console import Console
from skinrig.errors import UnusableError, UsageError, require_choice

Labels = Annotated[Path | None, option("CSV table name,TRAIT,... of 0 and 1, one row per face.")]

analyse_app = typer.Typer(cls=Subcommands, help="Analyse faces together.", no_args_is_help=True)


@analyse_app.callback()
def analyse() -> None:
    """Analyse faces together."""


@analyse_app.command("brdf", cls=Command)
@command
def analyse_brdf(
    appearances: list[Path] | None = None,
    /,
    *,
    out: Out,
    labels: Labels = None,
    merl_basis: Path | None = None,
    points: int | None = None,
    method: Annotated[str, choice("shares", "brdf")] = "shares",
    seed: int = 0,
    json: Json = False,
) -> None:
    """Estimate how many basis BRDFs faces need, and plot their mean reflectance.

    The number needed is the smallest whose error exceeds the minimum by at most 5 % of the fall
    from one basis BRDF to the minimum. Further columns list it for 2 % and 10 %, and the number at
    which the error falls below the noise.

    Example: skinrig analyse brdf appearance-a appearance-b --labels labels.csv --out analysis

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions with basis BRDFs; none: packaged estimates from
        simulated sessions of people.
    merl_basis
        Folder of the tables used in the reconstruction; default: built-in materials.
    points
        Texels per face, default 2000. Packaged sessions have up to 300 of the single subject in
        each condition and up to 60 of each person.
    method
        Space in which basis BRDFs are compared: shares (material weights) or brdf (reflectance).
    seed
        Random seed.
    """
    from reconstruction.brdf_basis.space import Method
    from skinrig.analysing import brdf as analysing_brdf

    how = require_choice("--method", method, get_args(Method))
    if points is not None and points < 20:
        raise UnusableError(f"--points: got {points}, expected 20 or more; raise it")
    console = Console(json)
    each = points or analysing_brdf.N_POINTS_PER_FACE
    if appearances:
        given: dict[str, Any] = {"labels": labels, "basis": merl_basis, "method": how, "seed": seed}
        found = analysing_brdf.analyze_measured(out, appearances, points_each=each, **given)
    elif labels is not None or merl_basis is not None:
        raise UsageError(
            "--labels, --merl-basis: apply to measured faces only; name APPEARANCE/ folders"
        )
    else:
        found = analysing_brdf.analyze_simulated(out, points_each=each, method=how, seed=seed)
    documents = [one.document() for one in found]
    console.print_table(
        ("data set", "needed", "by 2 %", "by 10 %", "to noise", "error", "held out", "noise"),
        ((d["name"], *_plateaus(d), *_at_plateau(d)) for d in documents),
    )
    for document in documents:
        left_out = document["left_out"]
        console.print_omissions(
            (f"{document['name']}, {r} basis BRDFs and more", why) for r, why in left_out
        )
        if document["points_lost"]:
            lost = document["points_lost"]
            console.print_line(f"{document['name']}: {lost} points without specular reflection")
    console.print_line(f"data: {analysing_brdf.SESSIONS_DATA}")
    console.print_line(f"{out}: figure-14.png, figure-15.png, curves.csv, analysis.json")
    console.print_document(
        "skinrig.analyse-brdf/1",
        {"out": out, "data": analysing_brdf.SESSIONS_DATA, "datasets": documents},
    )


@analyse_app.command("lumitexel", cls=Command)
@command
def analyse_lumitexel(
    appearance: Path,
    session: Path,
    /,
    *,
    out: Out,
    calibration: Path | None = None,
    at: list[str] | None = None,
    seed: int = 0,
    json: Json = False,
) -> None:
    """Draw the BRDF samples of points of a face over the hemisphere of light directions.

    Example: skinrig analyse lumitexel appearance session-dome --calibration calibration --out
    lumitexels

    Parameters
    ----------
    appearance
        APPEARANCE/ folder of the dome session, with normals.
    session
        Its SESSION/ folder.
    calibration
        CALIBRATION/ folder; default: the rig's nominal geometry.
    at
        Point on the skin, mm, rig frame, such as 0,60,70; repeatable; default: a point with many
        visible lights and one with many occluded ones.
    seed
        Random seed of the chosen points.
    """
    from skinrig.analysing import lumitexel
    from skinrig.rendering.request import parse_triple

    points = []
    for text in at or ():
        point = parse_triple(text)
        if point is None:
            raise UsageError(f"--at: got {text!r}, expected three numbers, mm: 0,60,70")
        points.append(point)
    console = Console(json)
    found = lumitexel.analyze_lumitexels(
        out, appearance, session, calibration=calibration, points_mm=tuple(points), seed=seed
    )
    for one in found["lumitexels"]:
        console.print_line(
            f"point {one['position_mm']} mm: {one['samples_of_the_view']} samples of camera "
            f"{one['view']}, {one['samples_of_all_views']} of all; "
            f"{one['occluded_lights']} lights not seen"
        )
    console.print_line(f"{out}: {', '.join(lumitexel.OUTPUT_FILES)}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-lumitexel/1", {"out": out, **figures})


@analyse_app.command("blood", cls=Command)
@command
def analyse_blood(
    appearance: Path,
    /,
    *,
    out: Out,
    landmarks: Path | None = None,
    radius: float | None = None,
    json: Json = False,
) -> None:
    """Test how near to Gaussian the blood of five regions of a face is distributed.

    The Anderson-Darling test rejects any real distribution if its sample is large enough. The
    p-value of all pixels, which neighbors repeat, is thus followed by that of pixels a correlation
    length apart, and by the number of independent samples that the test would reject.

    Example: skinrig analyse blood appearance-flash --out blood

    Parameters
    ----------
    appearance
        APPEARANCE/ folder of a flash session, with hemoglobin.
    landmarks
        CSV table name,x,y, pixels; default: the ground truth's own, else the face's outline.
    radius
        Radius of each region, px; default: image width / 32.
    """
    from skinrig.analysing import blood

    console = Console(json)
    found = blood.analyze_blood(out, appearance, landmarks=landmarks, radius_px=radius)
    console.print_table(
        ("region", "pixels", "distance", "A2", "p", "independent", "p of these", "rejected from"),
        (
            (
                row["region"],
                row["pixels"],
                f"{row['distance']:.3f}",
                f"{row['statistic']:.2f}",
                f"{row['p_value']:.2g}",
                f"{row['independent']:.0f}",
                "-" if row["spaced_p_value"] is None else f"{row['spaced_p_value']:.2g}",
                f"{row['rejected_from']:.0f}",
            )
            for row in found["regions"]
        ),
    )
    within = found["fraction_of_discs"]
    console.print_line(
        f"all discs: {100 * within['within_1_sd']:.1f} % within one deviation (Gaussian: 68.3 %), "
        f"{100 * within['within_2_sd']:.1f} % within two (95.4 %)"
    )
    console.print_line(f"{out}: {', '.join(blood.OUTPUT_FILES)}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-blood/1", {"out": out, **figures})


@analyse_app.command("profile", cls=Command)
@command
def analyse_profile(
    profile: Path | None = None,
    /,
    *,
    out: Out,
    length: float = 3.0,
    stretch: str = "0.8,1.35",
    seed: int = 0,
    json: Json = False,
) -> None:
    """Measure the surface length of a skin profile under stretch, with and without kernels.

    Example: skinrig analyse profile forearm.csv --stretch 0.8,1.35 --out profile

    Parameters
    ----------
    profile
        CSV table position_um,height_um at equal steps; default: a simulated forehead.
    length
        Length of the simulated profile, mm.
    stretch
        Stretch ratios, separated by commas.
    seed
        Random seed of the simulated skin.
    """
    from skinrig.analysing import profile as analysing_profile
    from skinrig.capturing.option_values import parse_floats

    console = Console(json)
    ratios = parse_floats(stretch, "--stretch") or analysing_profile.PAPER_STRETCHES
    if profile is None:
        heights, spacing_um = analysing_profile.simulate_profile(length, seed)
    else:
        heights, spacing_um = analysing_profile.read_profile(profile)
    source = f"simulated forehead, seed {seed}" if profile is None else str(profile)
    found = analysing_profile.analyze_profile(
        out, heights, spacing_um, source=source, stretches=ratios
    )
    console.print_table(
        (
            "stretch",
            "length, unchanged",
            "alpha",
            "sigma, um",
            "length, kernel",
            "alpha that keeps",
        ),
        (
            (
                row["stretch"],
                f"{row['unchanged_ratio']:.3f}",
                f"{row['table_alpha']:.2f}",
                f"{row['table_sigma_um']:.1f}",
                f"{row['table_ratio']:.3f}",
                f"{row['preserving_alpha']:.2f} (length {row['preserving_ratio']:.3f})",
            )
            for row in found["stretches"]
        ),
    )
    console.print_line(f"{out}: {', '.join(analysing_profile.OUTPUT_FILES)}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-profile/1", {"out": out, **figures})


@analyse_app.command("parameterization", cls=Command)
@command
def analyse_parameterization(source: Path, /, *, out: Out, json: Json = False) -> None:
    """Measure how the texture coordinates of a mesh distort areas and angles.

    Example: skinrig analyse parameterization appearance-dome --out distortion

    Parameters
    ----------
    source
        Mesh with texture coordinates (.obj, .ply, .npz), or APPEARANCE/ folder of a dome session.
    """
    from skinrig.analysing import parameterization

    console = Console(json)
    found = parameterization.analyze_parameterization(out, source)
    console.print_table(
        ("of the skin's area", "5 %", "50 %", "95 %"),
        (
            ("area per texel over its median", *_rounded(found["area_over_median"])),
            ("larger over smaller stretch", *_rounded(found["angle_ratio"])),
        ),
    )
    console.print_line(f"standard deviation of the logarithm of area: {found['log_area_sd']:.3f}")
    console.print_line(f"{out}: {parameterization.OUTPUT_FILE}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-parameterization/1", {"out": out, **figures})


@analyse_app.command("relief", cls=Command)
@command
def analyse_relief(
    relief: Path, /, *, moving: Path, mesh: Path, out: Out, seed: int = 0, json: Json = False
) -> None:
    """Measure seams and spectrum of synthesized microrelief against the measured patches.

    Example: skinrig analyse relief relief --moving moving --mesh head.npz --out measured

    Parameters
    ----------
    relief
        Folder written by `skinrig apply microstructure`.
    moving
        Folder written by `skinrig fit microstructure`.
    mesh
        Mesh that the map belongs to: .npz, OBJ or glTF.
    seed
        Random seed of interior samples and windows.
    """
    from skinrig.analysing.relief import OUTPUT_FILE, measure_relief

    console = Console(json)
    found = measure_relief(out, relief, moving=moving, mesh=mesh, seed=seed)
    console.print_table(
        ("octave, um", "over patches", "standard error", "windows", "patches, um", "their windows"),
        (
            (
                f"{row['longest_um']:g} to {row['shortest_um']:g}",
                *(f"{row[key]:.3f}" for key in ("ratio", "stderr")),
                row["windows"],
                f"{row['patch_rms_um']:.3f}",
                row["patch_windows"],
            )
            for row in found["octaves"]
        ),
    )
    console.print_line(
        f"neighboring pixels: 99 % differ by {found['interior']['99']:.3f} um or less"
    )
    if found["seam"] is None:
        console.print_line("seams: none")
    else:
        half, most = found["seam"].values()
        length = found["seam_length_mm"]
        console.print_line(f"seams, {length:.0f} mm: step {half:.3f} um, 99 % up to {most:.3f} um")
    console.print_line(f"{out}: {OUTPUT_FILE}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-relief/1", {"out": out, **figures})


def _rounded(values: dict[str, float]) -> list[str]:
    return [f"{value:.3f}" for value in values.values()]


@analyse_app.command("color-table", cls=Command)
@command
def analyse_color_table(
    table: Path | None = None,
    /,
    *,
    out: Out,
    camera: str | None = None,
    illuminant: str | None = None,
    tissue: Annotated[str | None, choice("skin", "papers")] = None,
    size: int | None = None,
    eumelanin_fraction: float | None = None,
    epidermal_blood_ratio: float | None = None,
    json: Json = False,
) -> None:
    """Write skin color against melanin and blood as EXR and CSV, on cube-root axes.

    `skinrig apply expression --color-table` reads both files.

    Example: skinrig analyse color-table --tissue papers --out table

    Parameters
    ----------
    table
        A table to check and convert, .exr or .csv; default: build one.
    camera
        Observer: linear sRGB (default), or a camera's spectral sensitivities.
    illuminant
        Light, such as D55; default D65.
    tissue
        Optics: skin (default, as for all rigs) or papers (the papers' model).
    size
        Nodes per axis, 8 to 512; default 64.
    eumelanin_fraction
        beta_m, 0 to 1; default: the tissue's, 0.8 or 0.61.
    epidermal_blood_ratio
        C_he / C_hd, 0 to 0.3125; default: the tissue's, 0 or 0.25.
    """
    from skinrig.analysing import color_table

    console = Console(json)
    given: dict[str, Any] = {
        "camera": camera,
        "illuminant": illuminant,
        "tissue": tissue,
        "size": size,
        "eumelanin_fraction": eumelanin_fraction,
        "epidermal_blood_ratio": epidermal_blood_ratio,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if table is not None and given:
        name = next(iter(given)).replace("_", "-")
        raise UsageError(f"--{name}: applies to a table that is built; remove it, or the file")
    made = color_table.build_table(**given) if table is None else table
    found = color_table.analyze_table(out, made)
    console.print_figures({"color table": found}, int, float, str)
    for name, lost in found["relative_loss"].items():
        console.print_line(f"{name}: read back within {lost:.1g}")
    console.print_line(f"{out}: {', '.join(color_table.OUTPUT_FILES)}")
    figures = {name: value for name, value in found.items() if name != "schema"}
    console.print_document("skinrig.analyse-color-table/1", {"out": out, **figures})


def _plateaus(document: dict[str, Any]) -> list[object]:
    """Return the plateau for 5, 2 and 10 % of the fall in error, and the rank at noise level."""
    by_share, at_noise = document["plateau_by_share"], document["rank_at_noise"]
    return [document["plateau"], by_share["0.02"], by_share["0.1"], at_noise or "-"]


def _at_plateau(document: dict[str, Any]) -> list[str]:
    """Format the errors at the plateau: in sample, held out, and of noise alone."""
    at = document["ranks"].index(document["plateau"])
    errors = (document["error"][at], document["held_out_error"][at], document["noise"])
    return ["-" if value is None else f"{100.0 * value:.1f} %" for value in errors]
