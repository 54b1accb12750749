"""Make ``docs/images/wiring-*.svg`` and the pin table of the build guide from the board's source.

Usage: python tools/make_wiring.py
"""

import re
from collections.abc import Sequence
from pathlib import Path

from make_rig_drawings import Drawing

ROOT = Path(__file__).resolve().parents[1]
FIRMWARE = ROOT / "firmware"
BOARD = FIRMWARE / "boards/mega2560/board.c"
GUIDE = ROOT / "docs/how-to/build-hardware.md"
IMAGES = ROOT / "docs/images"
PIN = re.compile(r"#define (PIN_\w+) \d+ +/\* (P\w\d), (D\d+)(?:: ([^*]+?))? \*/")
COMMON = ("PIN_STOP", "PIN_CAMERA", "PIN_LIGHT", "PIN_LIGHT_FAULT", "PIN_STEP", "PIN_DIRECTION")
USED = {
    "flash": (*COMMON, "PIN_POP", "PIN_POP_LED", "PIN_POP_FAULT"),
    "caliper": (
        *("PIN_STOP", "PIN_STEP", "PIN_DIRECTION", "PIN_JAW_STEP", "PIN_JAW_DIRECTION"),
        *("PIN_HOME", "PIN_HOLD"),
    ),
    "probe": (*COMMON, "PIN_SHUTTER", "PIN_BLADES_OPEN", "PIN_PUMP", "PIN_VENT"),
}
INPUT_PORT = "PL"
ANALOG = {
    "flash": (("D6: power of the pops", False),),
    "caliper": (("A0: force", True), ("A3: distance", True)),
    "probe": (
        *(("A1: gauge", True), ("A2: temperature", True)),
        *(("D6: level of the LED", False), ("D7: suction", False)),
    ),
}
"""By box, lines that are not digital, and whether the controller reads them."""
BY_FUNCTION = {
    "dome": (
        ("emergency stop, low is closed", True),
        ("one line per camera, opto-couplers", False),
        ("LED drivers, constant current, serial", False),
        ("open-LED report of the drivers", True),
        ("analyzer: step, direction (gradient sphere)", False),
    ),
    "scanner": (
        ("emergency stop, low is closed", True),
        ("one line per camera, opto-couplers (4)", False),
        ("displays of the projectors: number of the pattern (2)", False),
        ("lamps of the projectors: constant current, on or off (2)", False),
        ("open-lamp report of their drivers (2)", True),
    ),
}
"""Lines of boards without a table of pins, stop first, and whether the controller reads them."""
LOADS = {
    "flash": "flash packs, lamps",
    "caliper": "motors, clamps",
    "probe": "LED, pump, valves",
    "dome": "LED drivers",
    "scanner": "projector lamps",
}
CALL = re.compile(r"^\w+ \*?(board_\w+)\(", re.MULTILINE)


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


def call_table(header: str, sources: dict[str, str]) -> str:
    """Return the Markdown table of the board's functions, with the boxes that call each.

    `sources` are the texts of each box's files.
    """
    lines = ["| function of the board | boxes |", "| --- | --- |"]
    for name in CALL.findall(header):
        boxes = [box for box, text in sources.items() if f"{name}(" in text]
        every = len(boxes) == len(sources)
        lines.append(f"| `{name}` | {'all' if every else ', '.join(boxes)} |")
    return "\n".join(lines)


def box_sources() -> dict[str, str]:
    """Return the C text of each box, with what all share."""
    makefile = (FIRMWARE / "Makefile").read_text("utf-8")
    (shared,) = re.findall(r"^LEDS := (.*)$", makefile, re.MULTILINE)
    core = "".join((FIRMWARE / f"core/{name}.c").read_text("utf-8") for name in ("core", "main"))
    found = {}
    for box, files in re.findall(r"^(\w+)_FILES := (.*)$", makefile, re.MULTILINE):
        paths = files.replace("$(LEDS)", shared).split()
        found[box] = core + "".join((FIRMWARE / path).read_text("utf-8") for path in paths)
    return found


def fill(guide: str, mark: str, table: str) -> str:
    """Return the guide with a table between its two marks."""
    head, _, rest = guide.partition(f"<!-- {mark} -->\n")
    _, _, tail = rest.partition(f"<!-- /{mark} -->")
    return f"{head}<!-- {mark} -->\n\n{table}\n\n<!-- /{mark} -->{tail}"


def draw_wiring(box: str, labels: Sequence[tuple[str, bool]]) -> str:
    """Return the drawing of one box: the power path above, the controller's lines below.

    `labels` are the lines, the stop first, and whether the controller reads them.
    """
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
    stop_y = 140
    drawing.line((430, 74), (430, stop_y - 14))
    drawing.add("text", "contact 2", x=438, y=stop_y - 36)
    for place, (label, is_read) in enumerate(labels):
        y = stop_y + 26 * place
        tip, back = (260, 268) if is_read else (330, 322)
        drawing.line((260, y), (330, y))
        drawing.add("path", d=f"M {tip} {y} L {back} {y - 4} V {y + 4} Z", fill="#333")
        drawing.add("text", label, x=340, y=y + 4)
    drawing.add("text", "Never run on silicon.", x=20, y=height - 10, fill="#a00")
    return "\n".join([*drawing.parts, "</svg>", ""])


def make_files() -> dict[Path, str]:
    """Return the text of each drawing and of the guide, by path."""
    pins = pins_of(BOARD.read_text("utf-8"))
    lines: dict[str, Sequence[tuple[str, bool]]] = dict(BY_FUNCTION)
    for box, used in USED.items():
        rows = [pins[name] for name in used]
        digital = [(f"{n}: {what}", port.startswith(INPUT_PORT)) for port, n, what in rows]
        lines[box] = [*digital, *ANALOG[box]]
    found = {IMAGES / f"wiring-{box}.svg": draw_wiring(box, rows) for box, rows in lines.items()}
    guide = fill(GUIDE.read_text("utf-8"), "pins", pin_table(pins))
    header = (FIRMWARE / "boards/board.h").read_text("utf-8")
    return found | {GUIDE: fill(guide, "calls", call_table(header, box_sources()))}


def main() -> None:
    for path, text in make_files().items():
        path.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
