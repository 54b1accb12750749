"""Draw the head of a set of maps: its title, weakest result, rig and a captured image."""

import html
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import resources
from typing import Final

import numpy as np

from capture import raw
from capture.session import FrameRecord, Session, SessionError
from model.skin import SkinAppearance
from skinrig.appearances.contents import is_fused
from skinrig.appearances.dynamic import describe_parts
from skinrig.arrays import FloatArray
from skinrig.console import format_count
from skinrig.drawing import png
from skinrig.reporting import map_images, page, verdict
from skinrig.reporting.map_names import map_title
from skinrig.reporting.sections import dynamic, microrelief, sequence, subsurface
from skinrig.unit_format import format_quantity

RIG_TITLES: Final = {
    "flash": "Flash rig",
    "dome": "Light dome",
    "gradient": "Gradient rig",
    "probe": "Fiber probe",
}
_VIEW_BOX: Final = re.compile(r'viewBox="0 0 (\d+) (\d+)"')
OMITTED_FRAMES: Final = frozenset({"dark", "tracking"})
"""Kinds and patterns of frames that are not shown as the captured image."""
_UNUSED_NOISE: Final = {"gain": 1.0, "read_noise": 1.0}
"""Only the values of an image are drawn; their variance is not."""


def draw_head(subject: page.ReportedAppearance, session: Session | None) -> Iterator[page.Block]:
    """Yield the title, the weakest result, the drawing of the rig and captured images.

    Parameters
    ----------
    subject
        With the checks of its section.
    session
        Session that the maps were reconstructed from; None: not found.
    """
    appearance = subject.appearance
    rig = "" if session is None or is_fused(appearance) else session.rig.name
    title = _name_contents(appearance)
    title = f"{RIG_TITLES[rig]}: {title}" if rig in RIG_TITLES else title[:1].upper() + title[1:]
    yield page.Heading(title, 2, subject.name)
    if sentence := describe_weakest(subject.name, subject.checks, appearance):
        yield page.Paragraph(sentence)
    images = [_draw_rig(session)] if session is not None and rig in RIG_TITLES else []
    if not is_fused(appearance):
        images += _draw_captured(appearance, session)
    if images:
        yield page.Images(images)


def _name_contents(appearance: SkinAppearance) -> str:
    if dynamic.is_dynamic(appearance):
        has_color = "facial_color" in describe_parts(appearance)
        return (
            f"moving {'face: skin color by expression' if has_color else 'skin: surface by strain'}"
        )
    if is_fused(appearance):
        return "fused person: maps of all rigs"
    if "position" in appearance.maps:
        return "normals and reflectance"
    if microrelief.is_microrelief(appearance):
        return "surface topography by strain"
    if subsurface.is_probe(appearance):
        return "subsurface scattering"
    if sequence.is_sequence(appearance):
        return "blood in time"
    return "melanin and blood" if "melanin" in appearance.maps else "maps"


def describe_weakest(name: str, checks: Sequence[page.Check], appearance: SkinAppearance) -> str:
    """Return the check nearest to its limit; without checks, the least certain map.

    Parameters
    ----------
    name
        Of the appearance.
    checks
        Checks of its section.
    appearance
        Its maps.

    Examples
    --------
    >>> bare = SkinAppearance({}, "measured")
    >>> kept = page.Check("face: normals, mean error", 1.3, 2.0, "<=", "°", worst="nose: 1.6°")
    >>> describe_weakest("face", [kept], bare)
    'Weakest result: normals, mean error, 1.3° (limit 2°); largest for nose: 1.6°.'
    >>> describe_weakest("face", [], bare)
    ''
    """
    if not checks:
        uncertain = verdict.list_least_certain(name, appearance)
        least = uncertain[0].removeprefix(f"{name}: ") if uncertain else ""
        return f"Least certain: {least}.".replace(" %", "\N{NO-BREAK SPACE}%") if least else ""
    weakest = max(checks, key=lambda one: (not one.passed, one.used if one.used > 0.0 else 0.0))
    got, bound = (
        format_quantity(page.format_number(one), weakest.unit)
        for one in (weakest.got, weakest.bound)
    )
    what = weakest.name.removeprefix(f"{name}: ")
    label = "Weakest result" if weakest.passed else "Limit missed"
    where = f"; largest for {weakest.worst}" if weakest.worst else ""
    return f"{label}: {what}, {got} (limit {bound}){where}.".replace(" %", "\N{NO-BREAK SPACE}%")


def _draw_rig(session: Session) -> page.Image:
    """Return the drawing of the packaged rig of a session."""
    rig = session.rig.name
    text = resources.files("skinrig").joinpath(f"data/rig-{rig}.svg").read_text(encoding="utf-8")
    (width, height), title = _VIEW_BOX.findall(text)[0], re.findall("<title>(.*?)</title>", text)[0]
    address = png.to_data_url(text.encode(), "svg+xml")
    lights = format_count(len(session.rig.lights), "light")
    cameras = format_count(len(session.rig.views), "camera")
    caption = f"{RIG_TITLES[rig]}: full layout; this session used {lights} and {cameras}"
    return page.Image(caption, address, html.unescape(title), (int(width), int(height)))


def _draw_captured(appearance: SkinAppearance, session: Session | None) -> list[page.Image]:
    """Return the images among the maps; without them, a frame of the most frontal camera."""
    drawn: list[page.Image] = []
    white = 0.0
    for key in ("image", "specular_image"):
        one = appearance.maps.get(key)
        if one is not None and one.mask.any() and one.values.any():
            white = white or map_images.find_white(one.values, one.mask)
            shown = map_images.expose(one.values, one.mask, white)
            title = f"{map_title(key)}, linear RGB, white: {white:.2g}"
            drawn.append(map_images.draw_color_image(title, shown))
    if session is not None and not drawn:
        with suppress(SessionError, raw.RawError, OSError):
            drawn += [_draw_frame(session, one) for one in _choose_frame(session)]
    return drawn


def _choose_frame(session: Session) -> list[FrameRecord]:
    """Return a frame of the most frontal camera and light, in the middle of those; may be empty."""
    lit = [
        one
        for one in session.frames()
        if OMITTED_FRAMES.isdisjoint((one.kind, one.index.get("pattern")))
    ]
    places = {one.name: one.position_mm for one in session.rig.lights}
    places |= {one.name: one.position_mm for one in session.rig.views}
    cosines = {name: at[2] / (math.hypot(*at) or 1.0) for name, at in places.items()}
    names = [(one.camera, str(one.settings.get("light"))) for one in lit]
    ranks = [(cosines.get(camera, 0.0), cosines.get(light, 0.0)) for camera, light in names]
    best = max(ranks, default=None)
    first = [one for one, rank in zip(lit, ranks, strict=True) if rank == best]
    return first[len(first) // 2 :][:1]


def _draw_frame(session: Session, record: FrameRecord) -> page.Image:
    """Return a frame of a session at its own exposure."""
    frame = session.read(record)
    if frame.pattern == "MONO":
        balanced = ""
        values, _, _ = raw.linear_mono(frame, **_UNUSED_NOISE)
        linear: FloatArray = np.repeat(values[..., None], 3, axis=-1)
    else:
        balanced = " after white balance"
        balance: FloatArray = np.array(frame.neutral or (1.0, 1.0, 1.0), np.float32)
        linear = raw.linear_rgb(frame, demosaic="centered", **_UNUSED_NOISE).rgb / balance
    white = map_images.find_white(linear, np.ones(linear.shape[:2], bool))
    title = (
        f"captured frame, camera {record.camera}, step {record.step_id}; "
        f"white is {white:.2g} of full scale{balanced}"
    )
    return map_images.draw_color_image(title, linear / white, lossy=True)
