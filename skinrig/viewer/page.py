"""Pack a scene, our shaders and our script into ONE HTML page that asks the network for nothing."""

import base64
import hashlib
import json
import re
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Final

from skinrig.drawing import templates
from skinrig.viewer.packing.arrays import Packed, pack
from skinrig.viewer.packing.page_text import as_text
from skinrig.viewer.scene import ViewerScene

SCRIPT_NAMES: Final = (
    "graph gl load mesh camera color shading shadow crowd strain wrinkles detail microstructure "
    "tiles scattering reflectance display costs probes drag address panel controls main"
).split()
"""Scripts in the order in which they run, all in one function; `main.js` comes last."""

_CHUNK_LINE = re.compile(r"^//@chunk (\w+)[ \t]*$", re.MULTILINE)


class PageError(ValueError):
    """A piece of the page that is named twice."""


def chunks() -> dict[str, str]:
    """Return the pieces of GLSL by name.

    Raises
    ------
    PageError
        Two pieces have one name.
    """
    found: dict[str, str] = {}
    for entry in sorted(_files("glsl", ".glsl"), key=lambda one: one.name):
        parts = _CHUNK_LINE.split(entry.read_text(encoding="utf-8"))
        for name, text in zip(parts[1::2], parts[2::2], strict=True):
            if name in found:
                raise PageError(f"glsl/{entry.name}: chunk {name!r} is there twice")
            found[name] = _bare(text.strip("\n") + "\n")
    return found


def script() -> str:
    """Return all scripts as one strict function that shares an object ``V``."""
    here = resources.files("skinrig.viewer").joinpath("js")
    body = "\n".join(
        _bare(here.joinpath(f"{name}.js").read_text(encoding="utf-8")) for name in SCRIPT_NAMES
    )
    glsl = json.dumps(chunks(), sort_keys=True)
    return f'(() => {{\n"use strict";\nconst V = {{glsl: {glsl}}};\n{body}\n}})();\n'


def build(scene: ViewerScene, *, connect: bool = False) -> str:
    """Return the page of a scene.

    Parameters
    ----------
    scene
        What it shows.
    connect
        Whether it may ask the server it came from for more (tiles); a page in a file may not.

    Returns
    -------
    str
        HTML, the same for the same scene.
    """
    return render(pack(scene), connect=connect)


def render(packed: Packed, *, connect: bool = False) -> str:
    """Return the page of a packed scene."""
    here = resources.files("skinrig.viewer")
    style = here.joinpath("page.css").read_text(encoding="utf-8")
    code = script().replace("</", "<\\/")
    source = "'self'" if connect else "'none'"
    policy = (
        f"default-src 'none'; script-src '{_hash(code)}'; style-src '{_hash(style)}'; "
        f"img-src data: blob:; connect-src {source}; base-uri 'none'; form-action 'none'"
    )
    return templates.render(
        "viewer/page.html",
        policy=policy,
        style=style,
        header=packed.header_bytes().decode("utf-8").replace("<", "\\u003c"),
        payload=as_text(packed.payload),
        script=code,
    )


def _bare(text: str) -> str:
    """Return a script without lines that are comments, and without indentation."""
    return re.sub(r"^[ \t]+", "", re.sub(r"^[ \t]*//.*\n", "", text, flags=re.M), flags=re.M)


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode()


def _files(folder: str, ending: str) -> list[Traversable]:
    here = resources.files("skinrig.viewer").joinpath(folder)
    return [entry for entry in here.iterdir() if entry.name.endswith(ending)]
