"""`skinrig report` and `skinrig view`: HTML pages of results and of a live face."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from skinrig.command_line import completion
from skinrig.command_line.options import (
    STDOUT_MARK,
    Json,
    Page,
    check_output_file,
    check_output_page,
    command,
)
from skinrig.console import Console, format_count, select_attributes
from skinrig.errors import EXIT_LIMIT_MISSED, UnusableError, UsageError

MAX_PORT = 65_535


@command
def report(
    paths: list[Path],
    /,
    out: Annotated[Path, typer.Option("-o", "--out", callback=check_output_file)] = Path(
        "report.html"
    ),
    compare: Annotated[
        bool | None, typer.Option("--compare/--no-compare", show_default=False)
    ] = None,
    json: Json = False,
) -> None:
    """Write a self-contained HTML report on everything at PATHS.

    Exactly two sets of maps, two benchmarks, two folders of images or two folders of runs are
    compared; both use the ground truths found next to them. Other inputs are reported one by one.

    Example: skinrig report demo -o report.html

    Example: skinrig report monday tuesday -o difference.html

    Parameters
    ----------
    paths
        Folders or files written by skinrig.
    out
        HTML file to write; - is the standard output.
    compare
        Compare two runs side by side; default: if PATHS are exactly two of one kind.
    """
    from skinrig.atomic_file import write_atomically

    piped = str(out) == STDOUT_MARK
    if piped and json:
        raise UsageError("--out: got '-' with --json, whose document goes there; name a file")
    console = Console(json)
    talk = Console(json or piped)  # messages go to stderr if the page goes to stdout
    console.progress(f"draw the report of {format_count(len(paths), 'path')}")
    from skinrig.reporting.report import build_any

    place = None if piped else out.absolute().parent
    done = build_any(paths, compare=compare, folder=place, progress=console.progress)
    if piped:
        typer.echo(done.html, nl=False)
    else:
        write_atomically(out, done.html)
    size = len(done.html.encode())
    if done.compared is None:
        talk.print_line(done.verdict)
    else:
        talk.print_line(
            f"compared {' with '.join(done.compared)}; --no-compare reports both in full"
        )
        for verdict in done.sessions.values():
            talk.print_line(str(verdict))
    if not piped:
        talk.print_line(f"{out}: {size / 1e6:.2f} MB; open it in a browser")
    missed = [check for check in done.checks if not check.passed]
    for check in missed:
        if check.command:
            talk.print_line(f"missed: {check.name}; repeat: {check.command}")
    figures = {"path": out, "bytes": size, "checks": len(done.checks), "missed": len(missed)}
    figures["repeat"] = {check.name: check.command for check in missed if check.command}
    sessions = {name: verdict.document() for name, verdict in done.sessions.items()}
    figures |= {"compared": done.compared, "sessions": sessions}
    console.print_document("skinrig.report/1", figures)


@command
def status(
    folder: Path,
    /,
    out: Annotated[Path | None, typer.Option("-o", "--out", callback=check_output_page)] = None,
    json: Json = False,
) -> None:
    """List the state of every result in a folder, and how to repeat maps that need it.

    The exit code is 1 if a result has a fault or a check missed its limit.

    Example: skinrig status demo

    Example: skinrig status demo -o status.html

    Parameters
    ----------
    folder
        Folder of results, such as that of a demo.
    out
        HTML page to write; default: none.
    """
    from datetime import date

    from skinrig.atomic_file import write_atomically
    from skinrig.reporting.status import build_status_page, read_status

    console = Console(json)
    found = read_status(folder, today=date.today(), progress=console.progress)
    console.print_line(found.headline())
    rows = [(one.name, one.state, one.detail) for one in found.results]
    console.print_table(("result", "state", "detail"), rows)
    for fault in found.faults:
        if fault.command:
            console.print_line(f"{fault.name}: {fault.state}; repeat: {fault.command}")
    for check in found.missed:
        again = f"; repeat: {check.command}" if check.command else ""
        console.print_line(f"missed: {check.name}{again}")
    if out is not None:
        write_atomically(out, build_status_page(found))
        console.print_line(f"{out}: open it in a browser")
    console.print_document("skinrig.status/1", found.document() | {"path": out})
    if found.faults or found.missed:
        raise typer.Exit(EXIT_LIMIT_MISSED)


@dataclass(frozen=True, slots=True)
class ViewFaceOptions:
    """Geometry and color of the displayed face.

    Attributes
    ----------
    mesh
        Face geometry, with or without blend shapes: .npz, .obj (or a folder of them), .gltf or
        .glb; default: the maps' own.
    landmarks
        CSV table name,x,y of the flash rig's neutral image, which registers its maps to the mesh;
        default: the simulation's own.
    calibration
        CALIBRATION/ folder with the color of the dome's cameras; default: that of the
        reconstruction, or the sensor data of its session.
    """

    mesh: Path | None = None
    landmarks: Path | None = None
    calibration: Path | None = None


@dataclass(frozen=True, slots=True)
class HeadOptions:
    """Options of the simulated head and of texture size.

    Attributes
    ----------
    preset
        Skin type of the simulated head: I to VI, palest or darkest; default III.
    seed
        Random seed of the simulated head.
    size_px
        Width and height of textures, texels, 64 to 4096; default 2048, with people or of a picture
        1024.
    people
        Skin types of several simulated people on one head, separated by commas: II,IV,VI.
    """

    preset: Annotated[str | None, typer.Option(autocompletion=completion.complete_subjects)] = None
    seed: int = 0
    size_px: int | None = None
    people: str | None = None


@command
def view(
    appearance: list[Path] | None = None,
    /,
    *,
    out: Page = Path("page.html"),
    face: ViewFaceOptions,
    port: int | None = None,
    displacement: Path | None = None,
    head: HeadOptions,
    json: Json = False,
) -> None:
    """Write a self-contained interactive page of a face, or of an image with normals.

    Example: skinrig view -o page.html

    Example: skinrig view demo/appearance-flash-moving-III -o face.html

    Example: skinrig view demo/appearance-dome-III --size-px 1024 --port 0

    Example: skinrig view demo/appearance-gradient-forehead -o forehead.html

    Example: skinrig view --people II,IV,VI -o people.html

    Parameters
    ----------
    appearance
        Folders of maps of one face, by `skinrig reconstruct` or `fit`, or one with normals in an
        image; none: a simulated head.
    port
        Serve the page on this local port instead of writing a file; 0: any free port.
    displacement
        Heights of microstructure, um, over the mesh's texture (with --port): .npy file of
        `skinrig apply microstructure`, 4096 x 4096 or 16384 x 16384.
    """
    from skinrig.capturing.option_values import parse_names
    from skinrig.viewer import faces, page, server

    console = Console(json)
    if port is not None and not 0 <= port <= MAX_PORT:
        raise UnusableError(f"--port: got {port}, expected 0 to {MAX_PORT}; name another")
    if displacement is not None and port is None:
        raise UsageError("displacement: needs a served page; add --port 0")
    people = tuple(parse_names(head.people) or ())
    if people and head.preset is not None:
        raise UnusableError(f"--preset: got {head.preset} with --people; name each type there")
    given = select_attributes(face, "mesh", "landmarks", "calibration")
    given |= {"seed": head.seed, "size": head.size_px, "people": people}
    given |= {} if head.preset is None else {"preset": head.preset}
    console.progress("making textures and tables")
    scene = faces.build_scene(appearance or [], **given, progress=console.progress)
    console.progress("packing")
    document: dict[str, Any]
    if port is None:
        document = page.write(scene, out)
        shapes = "" if scene.page == "picture" else f", {document['blend_shapes']} blend shapes"
        console.print_line(
            f"{out}: {document['bytes'] / 1e6:.2f} MB, {document['textures']} textures"
            f"{shapes}; open it in a browser"
        )
    console.print_each("not measured", (f"{what}: {how}" for what, how in scene.added))
    console.print_omissions(scene.left_out)
    if port is None:
        console.print_document("skinrig.view/1", document)
    else:
        server.serve_scene(
            scene, port, appearance or [], console=console, displacement=displacement
        )
