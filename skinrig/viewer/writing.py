"""From what a user names to a page on disk or on a port of this machine."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from model import store
from skinrig import consent
from skinrig.console import Console
from skinrig.viewer import from_appearance, page, procedural, server
from skinrig.viewer.microstructure import assets as microstructure_assets
from skinrig.viewer.microstructure import tiles
from skinrig.viewer.packing import arrays as packing
from skinrig.viewer.scene import SceneError, ViewerScene
from skinrig.whole_file import write_whole


def compose(
    appearances: Sequence[Path],
    *,
    mesh: Path | None = None,
    landmarks: Path | None = None,
    calibration: Path | None = None,
    preset: str = "III",
    seed: int = 0,
    size: int = 2048,
    progress: Callable[[str], None] | None = None,
) -> ViewerScene:
    """Return the scene that a user asked for.

    Parameters
    ----------
    appearances
        Fitted folders of one face; none: a simulated head.
    mesh, landmarks, calibration, preset, seed, size
        As `skinrig.viewer.procedural.scene` and `skinrig.viewer.from_appearance.scene` take them.
    progress
        Called with one line a step.

    Raises
    ------
    SceneError
        For landmarks without a picture, and what the sources refuse.
    """
    if progress is not None:
        progress("making textures and tables")
    if appearances:
        scene = from_appearance.scene(
            appearances, mesh=mesh, landmarks=landmarks, calibration=calibration, size=size
        )
        agreed = consent.merge_consent(*map(store.read_document, appearances))
        if not agreed:
            return scene
        told = {**scene.provenance, consent.CONSENT_KEY: consent.format_consent(agreed)}
        return dataclasses.replace(scene, provenance=told)
    if landmarks is not None:
        raise SceneError(
            "landmarks: got a table but no appearance whose picture it belongs to; name the folder"
        )
    if calibration is not None:
        raise SceneError(
            "calibration: got a folder but no dome's appearance whose colors it is of; name one"
        )

    return procedural.scene(preset=preset, size=size, seed=seed, mesh=mesh)


def write(scene: ViewerScene, out: Path) -> dict[str, Any]:
    """Write the page of a scene, whole or not at all, and return what it holds.

    Parameters
    ----------
    scene
        What it shows.
    out
        File to write or replace.

    Returns
    -------
    dict
        JSON values: path, bytes, textures, blend shapes, quantization errors, what is left out.
    """
    packed = packing.pack(scene)
    text = page.render(packed).encode("utf-8")
    write_whole(out, text)
    return {
        "path": out,
        "bytes": len(text),
        "payload_bytes": len(packed.payload),
        "textures": len(scene.textures),
        "blend_shapes": len(scene.mesh.shapes),
        "triangles": len(scene.mesh.faces),
        "quantization_error": packed.errors,
        "provenance": dict(scene.provenance),
        "left_out": [list(row) for row in scene.left_out],
    }


def serve(
    scene: ViewerScene,
    port: int,
    appearances: Sequence[Path],
    *,
    console: Console,
    displacement: Path | None = None,
    seconds: float | None = None,
) -> None:
    """Serve the page of a scene on this machine until it is interrupted.

    Parameters
    ----------
    scene
        What it shows.
    port
        0: any free one.
    appearances
        Folders that it was made of.
    console
        Is told the address.
    displacement
        A .npy file of heights, um, in the texture of the mesh: fetched as tiles, in place of relief
        that is grown in the page.
    seconds
        How long; None serves until Ctrl-C.

    Raises
    ------
    skinrig.viewer.server.ServerError, skinrig.viewer.microstructure.tiles.TileError
        A port that is taken; a file that is no displacement.
    """
    import tempfile

    with tempfile.TemporaryDirectory(prefix="skinrig-view-") as name:
        pyramid = None
        if displacement is not None:
            console.progress(f"cutting {displacement.name} into tiles")
            pyramid = tiles.open_displacement(displacement, Path(name) / "levels")
            scene = microstructure_assets.with_displacement(scene, pyramid)
        text = page.build(scene, connect=pyramid is not None).encode("utf-8")
        with server.serve(text, pyramid=pyramid, port=port) as served:
            document = {
                "url": served.url,
                "bytes": len(text),
                "appearances": [str(path) for path in appearances],
                "displacement": None if displacement is None else str(displacement),
                "displacement_px": None if pyramid is None else pyramid.size,
                "left_out": [list(row) for row in scene.left_out],
            }
            console.say(f"{served.url}: open it in a browser on this machine; Ctrl-C ends it")
            console.document("skinrig.view-served/1", document)
            try:
                served.wait(seconds)
            except KeyboardInterrupt:
                console.progress("no longer served")
