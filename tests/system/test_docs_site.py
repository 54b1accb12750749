"""The documentation site: form of its sources, and what the built pages load and contain."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
MAX_PROSE_CHARACTERS = 120
MAX_TABLE_COLUMNS = 5

LONG_LINES: dict[str, int] = {}
"""Prose lines above the limit per page; the counts may only fall."""

WIDE_TABLES = {"decisions/0011-patches-are-cut-not-blended.md": 1}
"""Tables above the limit per page; the counts may only fall."""

SEARCHED = {
    "subsurface scattering": (
        "concepts/fiber-probe-inversion.html",
        "concepts/skin-reflectance.html",
        "how-to/fiber-probe.html",
        "reference/glossary.html",
    ),
    "ground truth": (
        "concepts/ground-truth.html",
        "reference/maps.html",
        "reference/glossary.html",
    ),
    "interreflection": (
        "concepts/omissions.html",
        "validation/omissions.html",
        "reference/glossary.html",
    ),
    "credible interval": (
        "concepts/uncertainty.html",
        "reference/maps.html",
        "reference/glossary.html",
        "validation/flash-rig.html",
    ),
    "blood volume fraction": (
        "how-to/flash-rig.html",
        "reference/maps.html",
        "reference/glossary.html",
    ),
    "specular": (
        "concepts/dome-reconstruction.html",
        "how-to/flash-rig.html",
        "reference/maps.html",
    ),
    "illumination": (
        "concepts/nagano2015.html",
        "concepts/skin-reflectance.html",
        "reference/glossary.html",
    ),
    "photometric stereo": (
        "how-to/image-stacks.html",
        "concepts/dome-reconstruction.html",
        "reference/glossary.html",
    ),
    "olat": ("how-to/light-dome.html", "concepts/weyrich2006.html", "reference/glossary.html"),
    "rti": (
        "tutorials/rti-to-normals.html",
        "how-to/image-stacks.html",
        "reference/requirements.html",
        "reference/glossary.html",
    ),
    "white reference": (
        "how-to/calibrate-flash.html",
        "how-to/flash-rig.html",
        "reference/glossary.html",
    ),
    "basis brdf": (
        "how-to/light-dome.html",
        "concepts/dome-reconstruction.html",
        "reference/maps.html",
        "reference/glossary.html",
    ),
}
"""Terms of the field, and the pages where one looks for them."""


# sources -----------------------------------------------------------------------------------------


def outside_fences(page):
    """Lines of a page that are not in a block of code."""
    fence = ""
    for line in page.read_text("utf-8").splitlines():
        mark = re.match(r"\s*(`{3,})", line)
        if mark and not fence:
            fence = mark[1]
        elif mark and line.strip() == fence:
            fence = ""
        elif not fence:
            yield line


def is_prose(line):
    return not line.lstrip().startswith("|") and not re.match(r"\s*\[[^\]]+\]: ", line)


def test_prose_lines_have_at_most_120_characters():
    found = {}
    for page in PAGES:
        prose = filter(is_prose, outside_fences(page))
        count = sum(len(line) > MAX_PROSE_CHARACTERS for line in prose)
        if count:
            found[page.relative_to(DOCS).as_posix()] = count
    assert found == LONG_LINES


def test_tables_have_at_most_five_columns():
    found = {}
    for page in PAGES:
        heads = [line for line in outside_fences(page) if re.fullmatch(r"\s*\|[ :|-]+\|", line)]
        count = sum(line.count("|") - 1 > MAX_TABLE_COLUMNS for line in heads)
        if count:
            found[page.relative_to(DOCS).as_posix()] = count
    assert found == WIDE_TABLES


def test_rig_drawings_match_their_rig_files(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("drawings", ROOT / "tools/make_rig_drawings.py")
    drawings = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawings)
    folders = drawings.FOLDERS
    monkeypatch.setattr(drawings, "FOLDERS", [tmp_path])
    drawings.main()
    made = sorted(tmp_path.iterdir())
    assert len(made) == 4
    for path in made:
        for folder in folders:
            assert path.read_text("utf-8") == (folder / path.name).read_text("utf-8")


def test_gallery_images_are_small_and_scripted():
    page = (DOCS / "gallery/index.md").read_text("utf-8")
    shown = set(re.findall(r"\.\./images/([\w.-]+)\)", page))
    tools = [path.read_text("utf-8") for path in sorted((ROOT / "tools").glob("make_*.py"))]
    named = [name for name in shown if not any(name in text for text in tools)]
    # names of chromophores are filled in
    assert set(named) <= {"gallery-melanin.png", "gallery-hemoglobin.png"}
    assert sum((DOCS / "images" / name).stat().st_size for name in shown) < 1.5e6


@pytest.mark.parametrize("term", SEARCHED)
def test_terms_of_the_field_occur_on_their_pages(term):
    texts = {
        page: (DOCS / page).with_suffix(".md").read_text("utf-8").lower() for page in SEARCHED[term]
    }
    found = re.compile(rf"\b{term.replace(' ', chr(92) + 's+')}s?\b")
    assert [page for page, text in texts.items() if not found.search(text)] == []


# the built site ----------------------------------------------------------------------------------

needs_extra = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("mkdocs", "material", "mkdocstrings"))),
    reason="the extra 'docs' is not installed: make docs",
)


def is_newer_than_sources(built):
    """Tell whether `make docs` made the site from the present manuals and docstrings."""
    if not built.is_file():
        return False
    packages = ("capture", "model", "reconstruction", "rigsim", "skinrig")
    sources = [
        ROOT / "mkdocs.yml",
        *(path for path in DOCS.rglob("*") if path.is_file()),
        *(path for name in packages for path in (ROOT / name).rglob("*.py")),
    ]
    return built.stat().st_mtime > max(path.stat().st_mtime for path in sources)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return the folder of the site: that of `make docs`, or one built for these tests."""
    if is_newer_than_sources(ROOT / "site" / "index.html"):
        return ROOT / "site"
    out = tmp_path_factory.mktemp("site")
    build = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(out)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert build.returncode == 0, build.stdout + build.stderr
    return out


class Loaded(HTMLParser):
    """Collects the addresses that a browser loads with a page."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        names = {"link": "href", "base": "href", "object": "data"}
        for name, value in attrs:
            loads = name in ("src", "srcset", "poster") or name == names.get(tag)
            if loads and value:
                self.addresses.append(value)
            if name == "style" and value:
                self.addresses += re.findall(r"url\(([^)]*)\)", value)


@pytest.mark.long
@needs_extra
def test_built_pages_load_nothing_from_outside(site):
    outside = []
    for page in site.rglob("*.html"):
        parser = Loaded()
        parser.feed(page.read_text("utf-8"))
        outside += [(page.name, one) for one in parser.addresses if re.match(r"(\w+:)?//", one)]
    for sheet in site.rglob("*.css"):
        loaded = re.findall(r"url\(([^)]*)\)|@import\s+(\S+)", sheet.read_text("utf-8"))
        names = ["".join(one).strip("\"'") for one in loaded]
        outside += [(sheet.name, one) for one in names if re.match(r"(\w+:)?//", one)]
    assert outside == []


@pytest.mark.long
@needs_extra
def test_built_pages_leave_scripts_nothing_to_fetch(site):
    # mermaid and repository figures are what the theme's script fetches from outside
    texts = {page.name: page.read_text("utf-8") for page in site.rglob("*.html")}
    assert [name for name, text in texts.items() if 'class="mermaid"' in text] == []
    assert [name for name, text in texts.items() if 'data-md-component="source"' in text] == []


@pytest.mark.long
@needs_extra
def test_search_index_finds_terms_of_the_field(site):
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))
    missing = []
    for term, pages in SEARCHED.items():
        found = {
            entry["location"].partition("#")[0]
            for entry in index["docs"]
            if re.search(rf"\b{term}s?\b", f"{entry['title']} {entry['text']}".lower())
        }
        missing += [(term, page) for page in pages if page not in found]
    assert missing == []
