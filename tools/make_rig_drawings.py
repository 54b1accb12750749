"""Make ``rig-*.svg`` for docs and reports: a drawing of each rig, to scale from its rig file.

Usage: python tools/make_rig_drawings.py
"""

import math
from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import escape

from capture.rig import Rig, load_rig

FOLDERS = [Path(__file__).resolve().parents[1] / name for name in ("docs/images", "skinrig/data")]
INK, LIGHT, CAMERA, SKIN, FILTER = "#333", "#e0a100", "#2b5c9e", "#d9a58b", "#7a3fa0"


class Drawing:
    """An SVG with a title and labels."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"'
            ' font-family="Helvetica, Arial, sans-serif" font-size="13">',
            f"<title>{escape(title)}</title>",
            f'<rect width="{width}" height="{height}" rx="8" fill="#fff"/>',
        ]

    def add(self, tag: str, text: str = "", **attributes: object) -> None:
        listed = " ".join(
            f'{name.replace("_", "-")}="{_number(value)}"' for name, value in attributes.items()
        )
        self.parts.append(
            f"<{tag} {listed}>{escape(text)}</{tag}>" if text else f"<{tag} {listed}/>"
        )

    def line(self, start: tuple[float, float], end: tuple[float, float], **style: object) -> None:
        (x1, y1), (x2, y2) = start, end
        self.add("line", x1=x1, y1=y1, x2=x2, y2=y2, **{"stroke": INK, **style})

    def dot(self, at: tuple[float, float], r: float, fill: str, **style: object) -> None:
        self.add("circle", cx=at[0], cy=at[1], r=r, fill=fill, **style)

    def dots(
        self, places: Iterable[tuple[float, float]], r: float, fill: str, **style: object
    ) -> None:
        """Draw dots as one path of round caps, coincident ones once: reports embed the file."""
        path = "".join(dict.fromkeys(f"M{_number(x)} {_number(y)}h0" for x, y in places))
        self.add("path", d=path, stroke=fill, stroke_width=2 * r, stroke_linecap="round", **style)

    def box(
        self, center: tuple[float, float], w: float, h: float, fill: str, **style: object
    ) -> None:
        x, y = center[0] - w / 2, center[1] - h / 2
        self.add("rect", x=x, y=y, width=w, height=h, fill=fill, **style)

    def label(
        self, at: tuple[float, float], text: str, anchor: str = "start", **style: object
    ) -> None:
        self.add("text", text, x=at[0], y=at[1], text_anchor=anchor, fill="#111", **style)

    def heading(self, at: tuple[float, float], text: str) -> None:
        self.label(at, text, font_weight="bold")

    def save(self, name: str) -> None:
        text = "\n".join([*dict.fromkeys(self.parts), "</svg>", ""])
        for folder in FOLDERS:
            (folder / f"rig-{name}.svg").write_text(text, encoding="utf-8")


def _number(value: object) -> str:
    return f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)


def _face(drawing: Drawing, at: tuple[float, float], w: float, h: float) -> None:
    drawing.add("ellipse", cx=at[0], cy=at[1], rx=w / 2, ry=h / 2, fill=SKIN, stroke=INK)


# the rigs ----------------------------------------------------------------------------------------


def draw_flash(rig: Rig) -> Drawing:
    """Return the flash rig from above."""
    drawing = Drawing(
        760, 430, "Flash rig from above: face, camera with rotating analyzer, two polarized flashes"
    )
    scale, origin = 0.3, (250.0, 355.0)

    def at(x: float, z: float) -> tuple[float, float]:
        return origin[0] + scale * x, origin[1] - scale * z

    drawing.heading((20, 28), "From above")
    camera = rig.views[0].position_mm
    _face(drawing, at(0, -75), 48, 58)
    drawing.label(
        (origin[0], origin[1] + 68), "subject; the origin is the center of the face", "middle"
    )
    for light in rig.lights:
        x, _, z = light.position_mm
        drawing.line(at(x, z), at(0, 0), stroke=LIGHT, stroke_dasharray="5 4")
        drawing.box(at(x, z), 34, 22, LIGHT, stroke=INK)
        drawing.box(at(0.94 * x, 0.94 * z), 34, 4, FILTER)
        side = -1 if x < 0 else 1
        here = at(x, z)
        drawing.label(
            (here[0] + side * 26, here[1] + 2),
            f"flash {light.name}",
            "end" if side < 0 else "start",
        )
        drawing.label(
            (here[0] + side * 26, here[1] + 20),
            "polarizer",
            "end" if side < 0 else "start",
            font_size=12,
        )
    here = at(camera[0], camera[2])
    drawing.line(here, at(0, 0), stroke=CAMERA)
    drawing.box(here, 36, 26, CAMERA, stroke=INK)
    drawing.box((here[0], here[1] + 20), 40, 4, FILTER)
    drawing.label((here[0], here[1] - 18), "camera cam", "middle")
    angle = math.degrees(
        math.atan2(abs(rig.lights[0].position_mm[0]), rig.lights[0].position_mm[2])
    )
    drawing.label((origin[0] + 12, origin[1] - 130), f"{camera[2]:.0f} mm", font_size=12)
    drawing.label((origin[0] - 48, origin[1] - 200), f"{angle:.0f}°", font_size=12)
    drawing.line((here[0] + 26, here[1] + 20), (500, here[1] + 56), stroke_width=0.8)
    drawing.label((505, here[1] + 60), "rotating analyzer:")
    drawing.label((505, here[1] + 78), "0° parallel, 90° crossed", font_size=12)
    drawing.box((610, 250), 220, 54, "#e8eef7", stroke=INK)
    drawing.label((610, 246), "controller", "middle", font_weight="bold")
    drawing.label((610, 264), "flashes, analyzer, release", "middle", font_size=12)
    drawing.box((610, 360), 220, 40, "#e8eef7", stroke=INK)
    drawing.label((610, 365), "computer", "middle", font_weight="bold")
    drawing.line((610, 340), (610, 277))
    drawing.label((618, 313), "wire protocol", font_size=12)
    return drawing


def draw_dome(rig: Rig) -> Drawing:
    """Return the dome from the front and from the side."""
    drawing = Drawing(760, 430, "Light dome from the front and from the side: LEDs, cameras, face")
    scale = 0.2
    for title, axis, origin in (
        ("From the front", 0, (190.0, 215.0)),
        ("From the side", 2, (560.0, 215.0)),
    ):
        drawing.heading((origin[0] - 170, 28), title)
        _face(drawing, origin, 40 if axis == 0 else 44, 54)
        at = [light.position_mm for light in rig.lights]
        places = [(origin[0] + scale * p[axis], origin[1] - scale * p[1]) for p in at]
        drawing.dots(places, 3.2, LIGHT)
        for view in rig.views:
            p = view.position_mm
            drawing.box(
                (origin[0] + scale * p[axis], origin[1] - scale * p[1]),
                11,
                9,
                CAMERA,
                stroke="#fff",
            )
    drawing.label((560, 368), "the face looks to the right, +z", "middle", font_size=12)
    drawing.dot((30, 404), 4, LIGHT, stroke=INK)
    drawing.label(
        (42, 409),
        f"{len(rig.lights)} LEDs, {_radius(rig.lights):.0f} mm from the center of the head",
    )
    drawing.box((420, 404), 12, 10, CAMERA)
    drawing.label((434, 409), f"{len(rig.views)} cameras, {_radius(rig.views):.0f} mm")
    return drawing


def _radius(parts: object) -> float:
    found = sorted(math.hypot(*part.position_mm) for part in parts)  # type: ignore[attr-defined]
    return found[len(found) // 2]


def draw_gradient(rig: Rig) -> Drawing:
    """Return the gradient sphere from the side, and the caliper as the camera sees it."""
    drawing = Drawing(
        760, 430, "Gradient rig: sphere of polarized LEDs from the side, and the caliper on skin"
    )
    scale, origin = 0.27, (200.0, 215.0)
    drawing.heading((20, 28), "Sphere, from the side")
    at = [light.position_mm for light in rig.lights]
    places = [(origin[0] + scale * p[2], origin[1] - scale * p[1]) for p in at]
    drawing.dots(places, 3.2, LIGHT, opacity=0.5)
    camera = (origin[0] + scale * rig.views[0].position_mm[2], origin[1])
    drawing.line(origin, camera, stroke=CAMERA)
    drawing.box(camera, 34, 24, CAMERA, stroke=INK)
    drawing.box((camera[0] - 22, camera[1]), 4, 32, FILTER)
    drawing.box(origin, 8, 40, SKIN, stroke=INK)
    drawing.label((origin[0], origin[1] + 38), "skin patch", "middle", font_size=12)
    drawing.label((camera[0], camera[1] - 24), "macro camera", "middle", font_size=12)
    drawing.label((camera[0] - 22, camera[1] + 34), "analyzer", "middle", font_size=12)
    drawing.dot((30, 404), 4, LIGHT, stroke=INK)
    drawing.label(
        (42, 409), f"{len(rig.lights)} polarized LEDs, {_radius(rig.lights):.0f} mm from the patch"
    )
    caliper = rig.caliper
    assert caliper is not None  # noqa: S101
    drawing.heading((440, 28), "Caliper, as the camera sees it")
    middle, unit = (580.0, 210.0), 14.0
    drawing.box(middle, 260, 230, SKIN)
    half = unit * caliper.aperture_mm / 2
    for side in (-1, 1):
        drawing.box((middle[0] + side * (half + 26), middle[1]), 52, 120, "#c9c9c9", stroke=INK)
    field = unit * rig.views[0].field_mm[0]
    drawing.box(middle, field, field, "none", stroke=CAMERA, stroke_dasharray="5 4")
    drawing.line((middle[0] - half, middle[1]), (middle[0] + half, middle[1]), stroke_width=0.8)
    drawing.label((middle[0], middle[1] - 6), f"{caliper.aperture_mm:g} mm", "middle", font_size=12)
    drawing.label((middle[0], middle[1] - 68), "jaws, taped to the skin", "middle", font_size=12)
    drawing.label(
        (middle[0], middle[1] + 106),
        f"field of view {rig.views[0].field_mm[0]:.1f} mm",
        "middle",
        font_size=12,
    )
    steps = f"{caliper.first_step} to +{caliper.last_step} steps of {caliper.step_mm:g} mm"
    angles = ", ".join(f"{angle:g}" for angle in caliper.angles_deg)
    drawing.label((middle[0], 362), steps, "middle")
    drawing.label((middle[0], 382), f"at {angles}° from +x", "middle")
    return drawing


def draw_probe(rig: Rig) -> Drawing:
    """Return the probe's head on skin in section, and what its camera sees."""
    drawing = Drawing(
        760, 400, "Fiber probe: section of the head on skin, and the image of the fiber ends"
    )
    probe = rig.probe
    assert probe is not None  # noqa: S101
    origin, unit = (110.0, 200.0), 80.0
    drawing.heading((20, 28), "Head on the skin, in section")
    drawing.add("rect", x=20, y=origin[1], width=720, height=90, fill=SKIN)
    drawing.line((20, origin[1]), (740, origin[1]))
    drawing.box((origin[0] + unit * 3.6, 130), 680, 84, "#eee", stroke=INK)
    drawing.box(origin, 10, 0.1, INK)
    drawing.add("rect", x=origin[0] - 8, y=60, width=16, height=140, fill=LIGHT, stroke=INK)
    for radius in probe.radius_mm:
        drawing.add(
            "rect",
            x=origin[0] + unit * radius - 8,
            y=60,
            width=16,
            height=140,
            fill="#cfe0f5",
            stroke=INK,
        )
    drawing.label((origin[0], 52), "source", "middle", font_size=12)
    last = origin[0] + unit * probe.radius_mm[-1]
    drawing.label(
        ((origin[0] + last) / 2, 52),
        f"{len(probe.radius_mm)} detection fibers",
        "middle",
        font_size=12,
    )
    for depth, end in ((26, 5), (46, 12), (70, 26)):
        reach = origin[0] + unit * probe.radius_mm[end]
        (x, y), low = origin, origin[1] + 1.4 * depth
        curve = f"M{x:.0f} {y:.0f} C{x:.0f} {low:.0f} {reach:.0f} {low:.0f} {reach:.0f} {y:.0f}"
        drawing.add("path", d=curve, fill="none", stroke=LIGHT, stroke_width=2)
    drawing.label((730, 282), "light scattered below the surface", "end", font_size=12)
    near, second, far = probe.radius_mm[0], probe.radius_mm[1], probe.radius_mm[-1]
    distances = f"distances {near:.2f} to {far:.2f} mm, {second - near:.2f} mm apart"
    drawing.label(
        (20, 312), f"{distances}; suction of {probe.suction_mbar:.0f} mbar holds the head"
    )
    drawing.heading((20, 346), "Image of the fiber ends")
    drawing.add("rect", x=210, y=328, width=530, height=50, fill="#111")
    for number in range(len(probe.radius_mm)):
        drawing.dot(
            (228 + 18.3 * number, 353), 6, "#ffd9a0", opacity=max(0.05, math.exp(-0.14 * number))
        )
    return drawing


def main() -> None:
    """Write the four drawings."""
    for name, draw in (
        ("flash", draw_flash),
        ("dome", draw_dome),
        ("gradient", draw_gradient),
        ("probe", draw_probe),
    ):
        draw(load_rig(name)).save(name)


if __name__ == "__main__":
    main()
