"""The commands that show what was measured: one page, or a face drawn live."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from skinrig.commands.options import STDOUT_MARK, Json, Page, check_output_file, command
from skinrig.console import Console, select_attributes
from skinrig.errors import UnusableError, UsageError

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
    """Write one self-contained HTML page about what lies at PATHS.

    Two sets of maps, two benchmarks, two folders of pictures or two of runs are compared; truths
    beside them serve both. Anything else is shown one after the other.

    Example: skinrig report demo -o report.html

    Example: skinrig report monday tuesday -o difference.html

    Parameters
    ----------
    paths
        Folders that skinrig wrote.
    out
        The page; - is the standard output.
    compare
        Put two runs side by side; default: where PATHS are exactly two of one kind.
    """
    from skinrig.atomic_file import write_atomically
    from skinrig.report import make

    piped = str(out) == STDOUT_MARK
    if piped and json:
        raise UsageError("--out: got '-' with --json, whose document goes there; name a file")
    console = Console(json)
    talk = Console(json or piped)  # where the page goes nothing else does
    done = make(paths, compare=compare)
    if piped:
        typer.echo(done.html, nl=False)
    else:
        write_atomically(out, done.html)
    size = len(done.html.encode())
    if done.compared is None:
        talk.say(done.verdict)
    else:
        talk.say(f"compared {' with '.join(done.compared)}; --no-compare shows all of both")
    if not piped:
        talk.say(f"{out}: {size / 1e6:.2f} MB; open it in a browser")
    missed = sum(not check.passed for check in done.checks)
    figures = {"path": out, "bytes": size, "checks": len(done.checks), "missed": missed}
    console.document("skinrig.report/1", {**figures, "compared": done.compared})


@dataclass(frozen=True, slots=True)
class ViewFaceOptions:
    """Geometry and color of the face that is drawn.

    Attributes
    ----------
    mesh
        The face's geometry: .npz, .obj (or a folder of them), .gltf or .glb, with blend shapes or
        without.
    landmarks
        Table name,x,y of the flash rig's neutral picture, to lay its maps on the mesh; a simulation
        has its own.
    calibration
        CALIBRATION/ folder with the color of a dome's cameras; else the one its maps were made
        with, or what its session says of the sensor.
    """

    mesh: Path | None = None
    landmarks: Path | None = None
    calibration: Path | None = None


@dataclass(frozen=True, slots=True)
class HeadOptions:
    """The simulated head, and the size of all textures.

    Attributes
    ----------
    preset
        Skin type of a simulated head: I to VI, palest or darkest.
    seed
        Seed of a simulated head.
    size
        Texels a side of the textures, 64 to 4096.
    """

    preset: str = "III"
    seed: int = 0
    size: int = 2048


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
    """Write one self-contained page that draws a face live: expressions, blood, light, traits.

    Example: skinrig view -o page.html

    Example: skinrig view demo/appearance-flash-moving-II -o face.html

    Example: skinrig view demo/appearance-dome-III --size 1024 --port 0

    Parameters
    ----------
    appearance
        Folders of one face: what `skinrig fit` wrote, or a dome's maps; none: a simulated head.
    port
        Serve the page and its large displacement on this port of this machine alone, 0: any free
        one, in place of writing it.
    displacement
        With --port: heights of microstructure, um, in the mesh's texture: a .npy file, 4096 or
        16384 px a side, as `skinrig apply microstructure` writes.
    """
    from skinrig.viewer import faces, page, server

    console = Console(json)
    if port is not None and not 0 <= port <= MAX_PORT:
        raise UnusableError(f"--port: got {port}, expected 0 to {MAX_PORT}")
    if displacement is not None and port is None:
        raise UsageError("displacement: a page in a file cannot fetch it; add --port 0")
    given = select_attributes(face, "mesh", "landmarks", "calibration")
    given |= select_attributes(head, "preset", "seed", "size")
    console.progress("making textures and tables")
    scene = faces.scene(appearance or [], **given)
    document: dict[str, Any]
    if port is None:
        document = page.write(scene, out)
        console.say(
            f"{out}: {document['bytes'] / 1e6:.2f} MB, {document['textures']} textures, "
            f"{document['blend_shapes']} blend shapes; open it in a browser"
        )
    console.left_out(scene.left_out)
    if port is None:
        console.document("skinrig.view/1", document)
    else:
        server.serve_scene(
            scene, port, appearance or [], console=console, displacement=displacement
        )
