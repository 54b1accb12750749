"""Pack scene, shaders and scripts into one HTML page without network requests."""

import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinrig.atomic_file import write_atomically
from skinrig.drawing import templates
from skinrig.viewer.packing import PackedScene, pack
from skinrig.viewer.scene import Page, SceneError, ViewerScene

SCRIPT_NAMES: Final[Mapping[Page, Sequence[str]]] = {
    "head": (
        "graph gl load mesh camera color lights shading shadow crowd eyes hair strain wrinkles "
        "detail microstructure tiles scattering reflectance display costs probes drag address "
        "panel timeline compare controls main"
    ).split(),
    "picture": (
        "graph gl load camera display costs probes drag address panel compare controls picture main"
    ).split(),
}
"""Scripts of each page in the order in which they run, all in one function; `main.js` is last."""
GLSL_NAMES: Final[Mapping[Page, Sequence[str]]] = {
    "head": (
        "color display eye geometry hair microstructure reflectance scattering shading shadow "
        "strain wrinkles"
    ).split(),
    "picture": "display geometry picture".split(),
}
"""Files of GLSL of each page."""

_CHUNK_LINE = re.compile(r"^//@chunk (\w+)[ \t]*$", re.MULTILINE)


def read_chunks(of_page: Page = "head") -> dict[str, str]:
    """Read a page's chunks of GLSL, keyed by name.

    Raises
    ------
    SceneError
        If two chunks have one name.
    """
    found: dict[str, str] = {}
    here = resources.files("skinrig.viewer").joinpath("glsl")
    for entry in (here.joinpath(f"{name}.glsl") for name in GLSL_NAMES[of_page]):
        parts = _CHUNK_LINE.split(entry.read_text(encoding="utf-8"))
        for name, text in zip(parts[1::2], parts[2::2], strict=True):
            if name in found:
                raise SceneError(f"glsl/{entry.name}: chunk {name!r} occurs twice; rename one")
            found[name] = _bare(text.strip("\n") + "\n")
    return found


def build_script(of_page: Page = "head") -> str:
    """Join a page's scripts to one strict function with a shared object ``V``."""
    here = resources.files("skinrig.viewer").joinpath("js")
    body = "\n".join(
        _bare(here.joinpath(f"{name}.js").read_text(encoding="utf-8"))
        for name in SCRIPT_NAMES[of_page]
    )
    glsl = json.dumps(read_chunks(of_page), sort_keys=True)
    return f'(() => {{\n"use strict";\nconst V = {{glsl: {glsl}}};\n{body}\n}})();\n'


def build(scene: ViewerScene, *, connect: bool = False) -> str:
    """Build the page of a scene.

    Parameters
    ----------
    scene
        The displayed scene.
    connect
        Whether the page may fetch tiles from its own server; False for a page in a file.

    Returns
    -------
    str
        HTML; equal scenes give equal text.
    """
    return render(pack(scene), connect=connect)


def render(packed: PackedScene, *, connect: bool = False) -> str:
    """Render the page of a packed scene."""
    here = resources.files("skinrig.viewer")
    style = here.joinpath("page.css").read_text(encoding="utf-8")
    code = build_script(packed.header["page"]).replace("</", "<\\/")
    source = "'self'" if connect else "'none'"
    policy = (
        f"default-src 'none'; script-src '{templates.hash_inline(code)}'; "
        f"style-src '{templates.hash_inline(style)}'; img-src data: blob:; "
        f"connect-src {source}; base-uri 'none'; form-action 'none'"
    )
    return templates.render(
        "viewer/page.html",
        policy=policy,
        style=style,
        header=packed.header_bytes().decode("utf-8").replace("<", "\\u003c"),
        payload=encode_as_text(packed.payload),
        script=code,
    )


def write(scene: ViewerScene, out: Path) -> dict[str, Any]:
    """Write the page of a scene atomically and return its record.

    Parameters
    ----------
    scene
        The displayed scene.
    out
        File to write or replace.

    Returns
    -------
    dict
        JSON values: path, bytes, textures, blend shapes, quantization errors, omissions, parts that
        were not measured.
    """
    packed = pack(scene)
    text = render(packed)
    write_atomically(out, text)
    return {
        "path": out,
        "bytes": len(text.encode("utf-8")),
        "payload_bytes": len(packed.payload),
        "textures": len(scene.textures),
        "blend_shapes": len(scene.mesh.shapes),
        "triangles": len(scene.mesh.faces),
        "quantization_error": packed.errors,
        "provenance": dict(scene.provenance),
        "left_out": [list(row) for row in scene.left_out],
        "added": [list(row) for row in scene.added],
    }


def _bare(text: str) -> str:
    """Strip comment lines and indentation from a script."""
    return re.sub(r"^[ \t]+", "", re.sub(r"^[ \t]*//.*\n", "", text, flags=re.M), flags=re.M)


UNSAFE_CODES: Final = (0, 8, 9, 10, 11, 12, 13, 26, 27, 34, 38, 60, 127)
"""Codes of characters that HTML, editors or transports may change: control characters, line ends
and the beginning of markup."""


def encode_as_text(data: bytes) -> str:
    """Encode bytes as text with seven bits per byte of UTF-8 (base64: six).

    A character below 128 has seven bits, the highest first. An unsafe code (`UNSAFE_CODES`) and the
    seven bits that follow it become one character of two bytes:
    ``(index in UNSAFE_CODES + 1) * 128 + next``.

    Parameters
    ----------
    data
        Any bytes.

    Examples
    --------
    >>> [ord(one) for one in encode_as_text(bytes([131, 6]))]
    [65, 65, 64]
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    groups = np.concatenate([bits, np.zeros(-len(bits) % 7, np.uint8)]).reshape(-1, 7)
    codes = (np.packbits(groups, axis=1)[:, 0] >> 1).astype(np.uint16)
    unsafe = np.full(128, -1, np.int64)
    unsafe[list(UNSAFE_CODES)] = np.arange(len(UNSAFE_CODES))
    if len(codes) and unsafe[codes[-1]] >= 0:
        codes = np.append(codes, np.uint16(32))  # padding, as an unsafe last code needs a successor
    found = np.flatnonzero(unsafe[codes] >= 0)
    # in a run of unsafe codes, every second one is the successor of the code before it
    begins = np.diff(found, prepend=-2) > 1
    first = found[begins][np.cumsum(begins) - 1] if len(found) else found
    joining = found[(found - first) % 2 == 0]
    codes[joining] = (unsafe[codes[joining]] + 1) * 128 + codes[joining + 1]
    keep = np.ones(len(codes), np.bool_)
    keep[joining + 1] = False
    return codes[keep].astype("<u2").tobytes().decode("utf-16-le")
