"""Make ``docs/images/wiring-*.svg`` and the pin table of the build guide from the board's source.

Usage: python tools/make_wiring.py
"""

import re
from pathlib import Path

from make_rig_drawings import Drawing

ROOT = Path(__file__).resolve().parents[1]
BOARD = ROOT / "firmware/boards/mega2560/board.c"
GUIDE = ROOT / "docs/how-to/build-hardware.md"
IMAGES = ROOT / "docs/images"
PIN = re.compile(r"#define (PIN_\w+) \d+ +/\* (P\w\d), (D\d+)(?:: ([^*]+?))? \*/")
COMMON = ("PIN_CAMERA", "PIN_STOP", "PIN_LIGHT", "PIN_LIGHT_FAULT", "PIN_STEP", "PIN_DIRECTION")
USED = {
    "flash": (*COMMON, "PIN_POP", "PIN_POP_LED", "PIN_POP_FAULT"),
    "caliper": (
        *("PIN_STOP", "PIN_STEP", "PIN_DIRECTION", "PIN_JAW_STEP", "PIN_JAW_DIRECTION"),
        *("PIN_HOME", "PIN_HOLD"),
    ),
    "probe": (*COMMON, "PIN_SHUTTER", "PIN_BLADES_OPEN", "PIN_PUMP", "PIN_VENT"),
}
ANALOG = {
    "flash": ("D6: power of the pops",),
    "caliper": ("A0: force", "A3: distance"),
    "probe": ("A1: gauge", "A2: temperature", "D6: level of the LED", "D7: suction"),
}
DOME = (
    "one line a camera, opto-couplers",
    "LED drivers, constant current, serial",
    "open-LED report of the drivers",
    "analyzer: step, direction (gradient sphere)",
    "emergency stop, second contact",
)
LOADS = {
    "flash": "flash packs, lamps",
    "caliper": "motors, clamps",
    "probe": "LED, pump, valves",
    "dome": "LED drivers",
}


def pins_of(text: str) -> dict[str, tuple[str, str, str]]:
    """Return the board's pins: name -> port, Arduino number, purpose."""
    found = {name: (port, number, what or "") for name, port, number, what in PIN.findall(text)}
    direction = "direction of the stepper above"
    return {name: (p, n, what or direction) for name, (p, n, what) in found.items()}


def pin_table(pins: dict[str, tuple[str, str, str]]) -> str:
    """Return the Markdown table of all pins, with the boxes that use each."""
    lines = ["| pin | Arduino | purpose | boxes |", "| --- | --- | --- | --- |"]
    for name, (port, number, what) in pins.items():
        boxes = ", ".join(box for box, used in USED.items() if name in used)
        lines.append(f"| {port} | {number} | {what} | {boxes} |")
    return "\n".join(lines)


def draw_wiring(box: str, labels: list[str]) -> str:
    """Return the drawing of one box: the power path above, the controller's lines below."""
    height = 210 + 26 * len(labels)
    drawing = Drawing(760, height, f"Wiring of the {box} box, never run on silicon")
    path = ("supply, isolated", "fuse", "emergency stop, contact 1", LOADS[box])
    for place, what in enumerate(path):
        x = 20 + 185 * place
        drawing.add("rect", x=x, y=30, width=165, height=44, rx=6, fill="#fbe9d0", stroke="#333")
        drawing.add("text", what, x=x + 82, y=57, text_anchor="middle")
        if place:
            drawing.line((x - 20, 52), (x, 52), stroke_width=3)
    drawing.add(
        "rect", x=20, y=110, width=240, height=height - 140, rx=6, fill="#dce8f7", stroke="#333"
    )
    drawing.add("text", f"controller: {box}", x=140, y=140, text_anchor="middle")
    drawing.add("text", "USB to the host", x=140, y=162, text_anchor="middle")
    for place, label in enumerate(labels):
        y = 140 + 26 * place
        drawing.line((260, y), (330, y))
        drawing.add("text", label, x=340, y=y + 4)
    drawing.add("text", "Never run on silicon.", x=20, y=height - 10, fill="#a00")
    return "\n".join([*drawing.parts, "</svg>", ""])


def main() -> None:
    pins = pins_of(BOARD.read_text("utf-8"))
    for box, used in USED.items():
        labels = [f"{pins[name][1]}: {pins[name][2]}" for name in used]
        text = draw_wiring(box, [*labels, *ANALOG[box]])
        (IMAGES / f"wiring-{box}.svg").write_text(text, "utf-8")
    (IMAGES / "wiring-dome.svg").write_text(draw_wiring("dome", list(DOME)), "utf-8")
    guide = GUIDE.read_text("utf-8")
    head, _, rest = guide.partition("<!-- pins -->\n")
    _, _, tail = rest.partition("<!-- /pins -->")
    made = f"{head}<!-- pins -->\n\n{pin_table(pins)}\n\n<!-- /pins -->{tail}"
    GUIDE.write_text(made, "utf-8")


if __name__ == "__main__":
    main()
