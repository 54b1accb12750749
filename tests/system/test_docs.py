"""The documentation says what the code does: examples run, commands parse, links lead."""

import ast
import dataclasses
import doctest
import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer
from fixtures.product_code import PACKAGES, modules, nodes_of, text_of, tree_of

from capture.devices import wire
from capture.plan.rig_kinds import RIG_KINDS
from capture.rig import load_rig
from rigsim.boxes.controller import Controller
from rigsim.boxes.device import Wiring
from rigsim.boxes.flash import FlashUnit
from skinrig.cli import app
from skinrig.command_line.help import RigFileGroup, RigGroup

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
DECISIONS = sorted((DOCS / "decisions").glob("*.md"))
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page not in DECISIONS]
GENERATED = ("api", "command-line", "map-names.md", "schemas.md")
"""Pages and folders of the reference that tools/site_pages.py makes."""
GUIDES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`]+)`")


def named(paths):
    ids = [path.relative_to(ROOT).with_suffix("").as_posix() for path in paths]
    return pytest.mark.parametrize("page", paths, ids=ids)


def blocks(page, *languages):
    found = FENCE.findall(page.read_text("utf-8"))
    return [textwrap.dedent(body) for kind, body in found if kind in languages]


def prose(page):
    return FENCE.sub("", page.read_text("utf-8"))


def rows(page, heading):
    """Cells of the table below a heading, without its head."""
    section = page.read_text("utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [
        [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in lines
    ]


def flash_box():
    unit = FlashUnit(Wiring(rig=load_rig("flash"), rng=np.random.default_rng(0)))
    return Controller(unit, serial="FL-0001", rng=np.random.default_rng(1))


WIRE = DOCS / "reference" / "wire-protocol.md"


# python ------------------------------------------------------------------------------------------


@named([page for page in GUIDES if ">>> " in page.read_text("utf-8")])
def test_python_examples_produce_documented_output(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = "\n".join(blocks(page, "python"))
    test = doctest.DocTestParser().get_doctest(source, {}, page.name, str(page), 0)
    assert test.examples
    report = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


def test_every_python_block_is_an_example_that_runs():
    silent = [page.name for page in GUIDES for body in blocks(page, "python") if ">>> " not in body]
    assert silent == []


def exists(dotted):
    """Whether a dotted name of a package is a module or an attribute of one."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for name in parts[end:]:
            found = getattr(found, name, None)
        return found is not None
    return False


@named(GUIDES)
def test_python_names_in_text_exist(page):
    dotted = re.compile(rf"({'|'.join(PACKAGES)})(\.\w+)+")
    names = [match[0] for span in SPAN.findall(prose(page)) if (match := dotted.fullmatch(span))]
    # an entry point's group is not a module
    assert [name for name in names if name != "capture.cameras" and not exists(name)] == []


# wire --------------------------------------------------------------------------------------------


def test_manual_frames_have_canonical_spelling():
    lines = [line.encode() for body in blocks(WIRE, "wire") for line in body.splitlines()]
    assert len(lines) >= 5
    assert [wire.encode(wire.decode(line)) for line in lines] == [line + b"\n" for line in lines]


def test_manual_conversation_matches_emulated_controller_byte_for_byte():
    (text,) = blocks(WIRE, "dialogue")
    box, heard, printed = flash_box(), [], []
    for line in text.splitlines():
        time_s, mark, words = line.split(" ", 2)
        if mark == ">":
            said = box.feed(words.encode() + b"\n", float(time_s))
        else:
            printed.append(words)
            said = box.advance(float(time_s))
        heard += said.decode().splitlines()
    assert heard == printed


def test_manual_lists_every_command_with_arguments_and_requirements():
    listed = {}
    for name, arguments, needs, _ in rows(WIRE, "Commands of the flash box"):
        listed[name.strip("`")] = (arguments.strip("`"), needs)
    expected = {}
    for name, command in flash_box().commands.items():
        needs = "" if name.endswith("?") else "frame"
        needs = "armed" if command.armed else "bare" if command.bare else needs
        expected[name] = (command.arguments, needs)
    assert listed == expected


def test_manual_lists_every_dome_controller_command():
    from capture.rig import load_rig
    from rigsim.world import World

    box = World(load_rig("dome")).box("dome")
    expected = {}
    for name, command in box.device.commands().items():
        needs = "armed" if command.armed else "" if name.endswith("?") else "frame"
        expected[name] = (command.arguments, needs)
    listed = {
        name.strip("`"): (arguments.strip("`"), needs)
        for name, arguments, needs, _ in rows(WIRE, "Commands of the dome's box")
    }
    assert listed == expected


@pytest.mark.parametrize(
    ("box_name", "heading"),
    [
        ("gradient_sphere", "Commands of the gradient sphere's box"),
        ("caliper", "Commands of the caliper's box"),
        ("probe", "Commands of the probe's box"),
        ("scanner", "Commands of the scanner's box"),
    ],
)
def test_manual_lists_every_later_rig_controller_command(box_name, heading):
    from capture.rig import load_rig
    from rigsim.world import World
    from rigsim.world.rig_boxes import BOXES

    dome = World(load_rig("dome")).box("dome").device.commands()
    shared = dome if box_name == "gradient_sphere" else {}
    rig = load_rig(BOXES[box_name].rig)
    box = World(rig.with_scanner() if box_name == "scanner" else rig).box(box_name)
    expected = {}
    for name, command in box.device.commands().items():
        needs = "bare" if command.bare else "" if name.endswith("?") else "frame"
        # what the page says of the dome it does not say again
        if name not in shared or name == "SEQ:DEF":
            expected[name] = (command.arguments, "armed" if command.armed else needs)
    listed = {
        name.strip("`"): (arguments.strip("`"), needs)
        for name, arguments, needs, _ in rows(WIRE, heading)
    }
    assert listed == expected


def test_the_manual_lists_every_code():
    cells = [row[column] for row in rows(WIRE, "Codes") for column in (0, 2)]
    assert sorted(map(int, cells)) == sorted(int(code) for code in wire.Code)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_shell_example_fires_served_controller():
    from capture.rig import load_rig
    from rigsim.world.serve import serve_world

    (script,) = blocks(WIRE, "bash")
    with serve_world(load_rig("flash").resized(16), seed=1) as served:
        host, port = served.addresses["flash"].removeprefix("socket://").rsplit(":", 1)
        for host_number in range(2):
            run = subprocess.run(
                ["bash", "-c", script],
                env={"HOST": host, "PORT": port, "PATH": "/usr/bin:/bin"},
                capture_output=True,
                text=True,
                timeout=30,
                check=False,
            )
            identity, *answers = run.stdout.splitlines()
            assert identity.startswith("RIGSIM,FLASH2,"), run.stderr
            codes = [wire.decode(answer.encode()).code for answer in answers]
            fired = codes.pop(2)
            assert codes == [wire.Code.OK] * 3, run.stdout
            assert fired == wire.Code.OK or (host_number and fired == wire.Code.RECYCLE)


# command line ------------------------------------------------------------------------------------


def shell_commands(page):
    text = "".join(blocks(page, "sh")).replace("\\\n", " ")
    return [
        shlex.split(line.removeprefix(".venv/bin/"), comments=True)[1:]
        for line in text.splitlines()
        if line.removeprefix(".venv/bin/").startswith("skinrig ")
    ]


def inline_commands(page):
    found = []
    for span in SPAN.findall(prose(page)):
        words = " ".join(span.split())
        if words.startswith("skinrig "):
            found.append(words.split()[1:])
    return found


@cache
def command_line():
    """The tree of commands: made for each use it would take most of these tests' time."""
    return typer.main.get_command(app)


def resolve(argv):
    command = command_line()
    words = list(argv)
    while hasattr(command, "commands"):
        if isinstance(command, RigFileGroup) and words and words[0].endswith(".toml"):
            words[0] = "flash"
        assert words, f"skinrig {' '.join(argv)}: names no command"
        assert words[0] in command.commands, f"skinrig {' '.join(argv)}: no such command"
        command = command.commands[words.pop(0)]
    return command, words


@named([page for page in GUIDES if shell_commands(page)])
def test_commands_in_shell_blocks_parse_with_nothing_missing(page):
    for argv in shell_commands(page):
        command, words = resolve(argv)
        command.make_context(command.name, words)


@named([page for page in GUIDES if inline_commands(page)])
def test_commands_in_text_exist_with_named_options(page):
    for argv in inline_commands(page):
        group = command_line().commands.get(argv[0])
        if isinstance(group, RigGroup) and (len(argv) == 1 or argv[1].startswith("-")):
            # of any rig: each option is one of some rig's
            words, rigs = argv[1:], [*group.commands.values()]
        elif isinstance(group, RigGroup) and argv[1] == "RIG":
            words, rigs = argv[2:], [*group.commands.values()]
        else:
            command, words = resolve(argv)
            rigs = [command]
        known = {name for one in rigs for parameter in one.params for name in parameter.opts}
        unknown = [word for word in words if word.startswith("-") and word not in known]
        assert not unknown, f"skinrig {' '.join(argv)}: {unknown}"


def test_the_pages_name_every_command_of_a_user():
    argvs = [argv for page in GUIDES for argv in (*shell_commands(page), *inline_commands(page))]
    commands = set(command_line().commands)
    assert {argv[0] for argv in argvs} == commands


# links, maps and messages ----------------------------------------------------------------------


def is_generated(path):
    """Whether the build of the site makes this page, which then checks links to it."""
    parts = path.resolve().relative_to(DOCS).parts
    return parts[0] == "reference" and parts[1] in GENERATED


@named([*GUIDES, *DECISIONS])
def test_relative_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    local = [t.partition("#")[0] for t in targets if "://" not in t and not t.startswith("#")]
    dead = [page.parent / target for target in local if not (page.parent / target).exists()]
    assert [path for path in dead if not is_generated(path)] == []


MAPS_PAGE = DOCS / "reference" / "maps.md"


def recipes():
    """Every recipe with the heading that its maps stand under."""
    from reconstruction.pipeline import recipes as pipeline

    headings = {
        "flash": "Maps of the flash rig",
        "dome": "Maps of the dome",
        "gradient": "Maps of the gradient rig",
        "probe": "Maps of the fiber probe",
    }
    assert headings.keys() == RIG_KINDS.keys()
    found = {
        heading: importlib.import_module(f"reconstruction.pipeline.{kind}.recipe").RECIPE
        for kind, heading in headings.items()
    }
    return {**found, "Maps of images under listed lights": pipeline.light_list_recipe()}


def test_maps_page_lists_every_map_of_every_recipe():
    listed = {
        heading: sorted(name for row in rows(MAPS_PAGE, heading) for name in SPAN.findall(row[0]))
        for heading in recipes()
    }
    assert listed == {heading: sorted(recipe.maps) for heading, recipe in recipes().items()}


def test_maps_page_lists_accompanying_files():
    listed = {
        SPAN.findall(row[0])[0]
        for heading in (
            "Files of the flash rig",
            "Files of the dome",
            "Files of the gradient rig",
            "Files of the fiber probe",
        )
        for row in rows(MAPS_PAGE, heading)
    }
    assert listed == {name for recipe in recipes().values() for name in recipe.files}


def test_dome_light_figures_match_its_plan():
    from capture.plan.dome import dome_plan
    from capture.rig import load_rig
    from skinrig.capturing.light_safety import light_figures

    rig = load_rig("dome")
    plan = dome_plan(rig)
    figures = light_figures(plan, rig)
    count = {kind: sum(s.kind == kind for s in plan.steps) for kind in ("olat", "tracking", "dark")}
    text = " ".join((DOCS / "how-to" / "light-dome.md").read_text("utf-8").split())
    assert count["olat"] == 2 * len(rig.lights)
    for claim in (
        f"plan of {len(plan.steps)} steps ({len(rig.lights)} lights",
        f"{count['tracking']} tracking frames, {count['dark']} darks;",
        f"darks; {plan.estimate_duration_s(rig):.0f} s)",
        f"{figures['flashes_per_s']:.1f} flashes in the worst second",
        f"{figures['flicker_rms']:.2f} of light between 3 and 65 Hz",
        f"at most {figures['led_ws']:.3g} Ws from one LED",
        f"of the {figures['limit_ws']:g} Ws allowed",
    ):
        assert claim in text, claim


def test_dome_light_limits_match_its_rig_file():
    from capture.rig import LedLimits, load_rig

    limits = load_rig("dome").leds or LedLimits()
    for names, shipped, _ in rows(DOCS / "how-to" / "light-dome.md", "Light: flicker and dose"):
        for name, value in zip(SPAN.findall(names), shipped.split(","), strict=True):
            assert float(re.search(r"[\d.]+", value).group()) == getattr(limits, name), name


def source_texts():
    """Every text in the source, with whatever is filled in left as a gap."""
    texts = []
    for path in modules(*PACKAGES):
        for node in nodes_of(tree_of(path), ast.JoinedStr):
            parts = (v.value if isinstance(v, ast.Constant) else "\0" for v in node.values)
            texts.append("".join(map(str, parts)))
        strings = nodes_of(tree_of(path), ast.Constant)
        texts += [node.value for node in strings if isinstance(node.value, str)]
    return texts + [path.read_text("utf-8") for path in sorted((ROOT / "tools").glob("*.sh"))]


def load_tool(name):
    """Load a module of tools/, which is not a package that is installed."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


error_codes = load_tool("error_codes")
TROUBLESHOOTING = DOCS / "how-to" / "troubleshooting.md"


def troubleshooting_rows():
    """Code and message cells of the page's rows; the code is empty for findings and symptoms."""
    lines = [line for line in TROUBLESHOOTING.read_text("utf-8").splitlines() if line[:1] == "|"]
    table, rows = False, []
    for cells in ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines):
        if set(cells[0]) != {"-"}:
            head = not cells[0] or error_codes.CODE.fullmatch(cells[0])
            table = cells[0] == "code" or (table and bool(head))
            rows += [cells[:2]] if table and cells[0] != "code" else []
    return rows


@cache
def read_texts():
    return error_codes.read_error_texts(ROOT, PACKAGES)


def code_faults(texts, listed):
    """Faults of coded messages, and of the codes that the page lists."""
    templates, codes = {}, {}
    for text in texts:
        templates.setdefault(text.code, set()).add(text.template)
        codes.setdefault(text.template, set()).add(text.code)
    faults = [f"{code}: {len(some)} messages" for code, some in templates.items() if len(some) > 1]
    faults += [f"{'+'.join(sorted(some))}: 1 message" for some in codes.values() if len(some) > 1]
    faults += [f"{code}: area" for code in templates if code[3:6] not in error_codes.AREAS]
    faults += [f"{code}: not in the page" for code in templates.keys() - set(listed)]
    faults += [f"{code}: not in the code" for code in set(listed) - templates.keys()]
    return faults + [f"{code}: twice in the page" for code in set(listed) if listed.count(code) > 1]


def test_error_codes_match_the_troubleshooting_page():
    texts = read_texts()
    assert len({text.code for text in texts}) >= 50
    assert code_faults(texts, [code for code, _ in troubleshooting_rows() if code]) == []


def test_every_code_in_source_ends_a_message():
    found = Counter((text.path, text.code) for text in read_texts())
    written = Counter(
        (path.relative_to(ROOT).as_posix(), code)
        for path in modules(*PACKAGES)
        for code in error_codes.CODE.findall(text_of(path))
        if not code.endswith("-000")  # the number of examples
    )
    assert written == found


def test_code_check_finds_missing_and_ambiguous_codes():
    text = error_codes.ErrorText("SR-SES-001", "is not a session; name one", "capture/a.py")
    other = dataclasses.replace(text, template="is closed; start a new one")
    assert code_faults([text], ["SR-SES-001"]) == []
    assert code_faults([text], []) == ["SR-SES-001: not in the page"]
    assert code_faults([], ["SR-SES-001"]) == ["SR-SES-001: not in the code"]
    assert code_faults([text, text], ["SR-SES-001"] * 2) == ["SR-SES-001: twice in the page"]
    assert code_faults([text, other], ["SR-SES-001"]) == ["SR-SES-001: 2 messages"]
    twin = dataclasses.replace(text, code="SR-SES-002")
    listed = ["SR-SES-001", "SR-SES-002"]
    assert code_faults([text, twin], listed) == ["SR-SES-001+SR-SES-002: 1 message"]


def test_messages_in_troubleshooting_are_messages_of_the_program():
    quotes = [
        quote for code, head in troubleshooting_rows() if not code for quote in SPAN.findall(head)
    ]
    assert len(quotes) > 30
    texts = "\n".join(source_texts())
    # three dots stand for what is filled in; `Checks` joins a name, what it got and expected
    gaps = re.compile(r"\.\.\.|: got |, expected ")
    pieces = [piece.strip() for quote in quotes for piece in gaps.split(quote)]
    missing = [piece for piece in pieces if piece not in texts]
    assert not missing, "\n".join(missing)
