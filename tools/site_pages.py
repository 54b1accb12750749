"""MkDocs hook: pages of the reference made from the code, and pages that show repository files.

MkDocs calls the functions named ``on_...``. A list of pages in the navigation of ``mkdocs.yml``
whose value is ``generated:NAME`` is filled in here.
"""

import ast
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # the code that is documented is that of this checkout
    sys.path.insert(0, str(ROOT))

PACKAGES = ("capture", "model", "reconstruction", "rigsim", "skinrig")
API_PACKAGES = ("capture", "model", "reconstruction")
SCHEMA = re.compile(r"skinrig\.[a-z.-]+/\d+")
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
CITATIONS = "<!-- generated: citations -->"
ERROR_CODES = "<!-- generated: error codes -->"
DOI = re.compile(r"10\.\d{4,5}/[^\s,;\"'|]*[A-Za-z0-9)]")
AUTHORS = re.compile(
    r"((?:(?:[A-Z]\. )*(?:de |van |von |d')?[A-Z][\w'’-]+(?:, and | and |, )?)+(?: et al\.)?),?"
    r" \(?(\d{4})\)?"
)
WORKS = {
    "10.1007/3-540-44480-7_21": "Triggs et al. 2000",
    "10.1007/s10237-010-0216-8": "Flynn et al. 2011",
    "10.1017/CBO9781139644181": "Born and Wolf 1999",
    "10.1109/34.888718": "Zhang 2000",
    "10.1109/TIP.2015.2405336": "Finlayson et al. 2015",
    "10.1117/3.725073": "Janesick 2007",
    "10.1145/1882261.1866167": "Jimenez et al. 2010",
    "10.1152/ajplegacy.1967.213.6.1532": "Fung 1967",
    "10.2312/EGWR/EGSR07/147-157": "d'Eon et al. 2007",
    "10.25039/TR.015.2018": "CIE 015:2018",
    "10.5594/SMPTE.ST2114.2017": "SMPTE ST 2114:2017",
}
"""Works whose authors and year are not written right before their DOI."""
LANGUAGES = {".py": "python", ".toml": "toml", ".sh": "sh", ".csv": "text", ".md": "md"}


# hooks -------------------------------------------------------------------------------------------


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the navigation's ``generated:`` lists."""
    lists: dict[str, Any] = {
        "generated:command-line": [*command_pages()],
        "generated:api": api_navigation(),
        "generated:decisions": [
            f"decisions/{path.name}" for path in sorted((ROOT / "docs/decisions").glob("*.md"))
        ],
    }
    config.nav = _filled(config.nav, lists)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {**command_pages(), **api_pages()}
    pages["reference/schemas.md"] = schemas_page()
    pages["reference/map-names.md"] = map_names_page()
    for path in linked_files():
        pages[_page_of(path)] = file_page(path)
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to repository files outside the manuals to the pages that show them."""
    folder = Path(page.file.src_uri).parent

    def lead(match: re.Match[str]) -> str:
        target = match[2]
        path = _outside(folder, target)
        if path is None:
            return match[0]
        leads_to = os.path.relpath(_page_of(path), folder)
        return f"{match[1]}{leads_to}{match[4]}"

    if CITATIONS in markdown:
        markdown = markdown.replace(CITATIONS, citations_table())
    if ERROR_CODES in markdown:
        markdown = markdown.replace(ERROR_CODES, error_code_tables())
    return LINK.sub(lead, markdown)


def _filled(entries: Any, lists: dict[str, Any]) -> Any:
    if isinstance(entries, list):
        return [_filled(entry, lists) for entry in entries]
    if isinstance(entries, dict):
        return {title: _filled(entry, lists) for title, entry in entries.items()}
    return lists.get(entries, entries)


# error codes -------------------------------------------------------------------------------------


def error_code_tables() -> str:
    """Return a table per area: code, message template, and the module that raises it."""
    from tools.error_codes import AREAS, read_error_texts

    rows: dict[str, dict[str, tuple[str, list[str]]]] = {area: {} for area in AREAS}
    for text in read_error_texts(ROOT, PACKAGES):
        _, paths = rows[text.code[3:6]].setdefault(text.code, (text.template, []))
        if text.path not in paths:
            paths.append(text.path)
    lines = []
    for area, found in rows.items():
        lines += [f"### {AREAS[area]}", "", "| code | message | module |", "| --- | --- | --- |"]
        for code, (template, paths) in found.items():
            listed = ", ".join(f"`{path}`" for path in paths)
            lines.append(f"| `{code}` | {_cell(template)} | {listed} |")
        lines.append("")
    return "\n".join(lines)


# files of the repository -------------------------------------------------------------------------


def _outside(folder: Path, target: str) -> Path | None:
    """Return the repository file outside ``docs/`` that a link leads to, relative to the root."""
    if ":" in target:
        return None
    path = Path(os.path.normpath(Path("docs") / folder / target))
    outside = path.parts[0] != "docs" and (ROOT / path).is_file()
    return path if outside else None


def _page_of(path: Path) -> str:
    return f"repository/{path.as_posix()}.md"


def linked_files() -> list[Path]:
    """Return the files outside ``docs/`` that a manual links to, relative to the root."""
    found = set()
    for manual in (ROOT / "docs").rglob("*.md"):
        folder = manual.parent.relative_to(ROOT / "docs")
        for match in LINK.finditer(manual.read_text("utf-8")):
            path = _outside(folder, match[2])
            if path is not None:
                found.add(path)
    return sorted(found)


def file_page(path: Path) -> str:
    """Return a page that shows a file, which the search leaves out."""
    text = (ROOT / path).read_text("utf-8").rstrip("\n")
    language = LANGUAGES.get(path.suffix, "text")
    front = "---\nsearch:\n  exclude: true\n---\n\n"
    return f"{front}# {path.as_posix()}\n\n````{language}\n{text}\n````\n"


# command line ------------------------------------------------------------------------------------


@cache
def command_pages() -> dict[str, str]:
    """Return a page for each command of ``skinrig``."""
    import typer

    from skinrig.cli import app

    root = typer.main.get_command(app)
    pages = {"reference/command-line/index.md": _command_index(root)}
    for name, command in sorted(root.commands.items()):
        pages[f"reference/command-line/{name}.md"] = _command_page(name, command)
    return pages


def _command_index(root: Any) -> str:
    from skinrig.command_line.help import HELP_SECTIONS, OTHER_SECTION, summarize_command

    lines = ["# Command line", "", root.help, ""]
    left = dict(root.commands)
    sections = [*HELP_SECTIONS, (OTHER_SECTION, tuple(left))]
    for title, names in sections:
        rows = [(name, summarize_command(left.pop(name))) for name in names if name in left]
        if rows:
            lines += [f"## {title}", "", "| command | effect |", "| --- | --- |"]
            lines += [f"| [`skinrig {name}`]({name}.md) | {_cell(text)} |" for name, text in rows]
            lines.append("")
    return "\n".join([*lines, "## Options of every command", "", *_options(root)])


def _command_page(name: str, command: Any) -> str:
    lines = [f"# skinrig {name}", "", *_help(command.help)]
    commands = getattr(command, "commands", None)
    if commands is None:
        return "\n".join([*lines, *_options(command)])
    for part, one in commands.items():
        lines += [f"## skinrig {name} {part}", "", *_help(one.help), *_options(one)]
    return "\n".join(lines)


def _help(text: str | None) -> list[str]:
    """Return paragraphs of help, examples as blocks of shell."""
    lines = []
    for paragraph in (text or "").split("\n\n"):
        words = " ".join(paragraph.split())
        examples = re.fullmatch(r"Examples?: (.*)", words)
        if examples:
            commands = re.split(r"; (?=skinrig )|(?<=\S) (?=skinrig [a-z])", examples[1])
            lines += ["```sh", *(one.strip() for one in commands), "```", ""]
        elif words:
            lines += [_prose(words), ""]
    return lines


def _options(command: Any) -> list[str]:
    """Return a table of a command's arguments and options."""
    from skinrig.command_line.help import format_argument

    context = command.make_context(command.name, [], resilient_parsing=True)
    rows = []
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is None:
            continue
        spelling, text = format_argument(record[0]), record[1]
        default = re.search(r" *\[default: (.*?)\]", text, re.DOTALL)
        required = "[required]" in text
        text = re.sub(r" *\[(default: .*?|required)\]", "", text, flags=re.DOTALL)
        shown = f"`{default[1]}`" if default else "required" if required else ""
        rows.append(f"| `{spelling.replace('|', chr(92) + '|')}` | {shown} | {_cell(text)} |")
    if not rows:
        return []
    return ["| argument or option | default | effect |", "| --- | --- | --- |", *rows, ""]


def _cell(text: str) -> str:
    return _prose(" ".join(text.split())).replace("|", "\\|")


def _prose(text: str) -> str:
    """Return help as Markdown: what it could take for markup is kept as it is."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*_<>\[\]])", r"\\\1", part) for part in parts
    )


# Python ------------------------------------------------------------------------------------------


@cache
def api_pages() -> dict[str, str]:
    """Return a page for each package whose functions are public."""
    pages = {}
    for package in API_PACKAGES:
        for folder in sorted(path.parent for path in (ROOT / package).glob("*/__init__.py")):
            names = _public_names(folder)
            if names:
                dotted = f"{package}.{folder.name}"
                pages[f"reference/api/{dotted}.md"] = _api_page(dotted, folder, names)
    return pages


def api_navigation() -> list[Any]:
    """Return the pages of the Python reference by package."""
    return [
        {
            package: [
                {Path(uri).stem.removeprefix(f"{package}."): uri}
                for uri in api_pages()
                if Path(uri).stem.startswith(f"{package}.")
            ]
        }
        for package in API_PACKAGES
    ]


def _public_names(folder: Path) -> list[str]:
    """Return what a package re-exports; of one that re-exports nothing, what its modules define."""
    package = ".".join(folder.relative_to(ROOT).parts)
    found = []
    for node in ast.parse((folder / "__init__.py").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(package):
            for name in node.names:
                if (ROOT / f"{node.module.replace('.', '/')}/{name.name}.py").is_file():
                    continue  # a module of the package
                found.append(f"{node.module}.{name.name}")
    if found:
        return found
    for path in sorted(folder.glob("*.py")):
        if path.name.startswith("_"):
            continue
        for node in ast.parse(path.read_text("utf-8")).body:
            public = isinstance(node, ast.FunctionDef | ast.ClassDef)
            if public and not node.name.startswith("_"):
                found.append(f"{package}.{path.stem}.{node.name}")
    return found


def _api_page(dotted: str, folder: Path, names: list[str]) -> str:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
    # a search for a term of the field leads to the manuals first
    lines = ["---", "search:", "  boost: 0.1", "---", "", f"# {dotted}", "", text, ""]
    module = ""
    for name in names:
        if name.rpartition(".")[0] != module:
            module = name.rpartition(".")[0]
            lines += [f"## {module.removeprefix(dotted + '.')}", ""]
        lines += [f"::: {name}", ""]
    return "\n".join(lines)


# maps and schemas --------------------------------------------------------------------------------


def _trees() -> Iterator[tuple[str, ast.Module]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text("utf-8"))


def schemas_page() -> str:
    """Return the list of JSON documents: their schema, the module that owns it, their fields."""
    owners: dict[str, str] = {}
    fields: dict[str, list[str]] = {}
    for path, tree in _trees():
        constants = _schema_constants(tree)
        for node in ast.walk(tree):
            if not isinstance(node, ast.Dict):
                continue
            keys = [key.value for key in node.keys if isinstance(key, ast.Constant)]
            if "schema" not in keys:
                continue
            value = node.values[[getattr(key, "value", None) for key in node.keys].index("schema")]
            name = _schema_of(value, constants)
            if name:
                owners.setdefault(name, path)
                fields.setdefault(name, [])
                fields[name] += [key for key in keys if key not in (*fields[name], "schema")]
        for name in constants.values():
            owners.setdefault(name, path)
    lines = [
        "# JSON documents",
        "",
        "Every JSON document names its schema in the field `schema`. The number after the slash"
        " changes when a field changes its meaning or is removed. Files and the output of"
        " `--json` use the same names. The fields are those that the module writes itself; a"
        " document can have more.",
        "",
        "| schema | defined in | fields |",
        "| --- | --- | --- |",
    ]
    for name in sorted(owners):
        listed = ", ".join(f"`{field}`" for field in fields.get(name, []))
        lines.append(f"| `{name}` | `{owners[name]}` | {listed} |")
    return "\n".join([*lines, ""])


def _schema_constants(tree: ast.Module) -> dict[str, str]:
    found = {}
    for node in tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = getattr(node, "value", None)
        if isinstance(target, ast.Name) and isinstance(value, ast.Constant):
            if isinstance(value.value, str) and SCHEMA.fullmatch(value.value):
                found[target.id] = value.value
    return found


def _schema_of(value: ast.expr, constants: dict[str, str]) -> str | None:
    if isinstance(value, ast.Name):
        return constants.get(value.id)
    text = value.value if isinstance(value, ast.Constant) else None
    return text if isinstance(text, str) and SCHEMA.fullmatch(text) else None


def map_names_page() -> str:
    """Return every map that can be asked for, with its unit where the name fixes it."""
    import importlib

    from capture.plan.rig_kinds import RIG_KINDS
    from model.skin import MAP_UNITS
    from reconstruction.pipeline.recipes import light_list_recipe

    made: dict[str, list[str]] = {}
    for rig in RIG_KINDS:
        for name in importlib.import_module(f"reconstruction.pipeline.{rig}.recipe").RECIPE.maps:
            made.setdefault(name, []).append(rig)
    for name in light_list_recipe().maps:
        made.setdefault(name, []).append("images under listed lights")
    lines = [
        "# Names of maps",
        "",
        "`skinrig reconstruct --maps` takes these names. [Maps](maps.md) explains each of them.",
        "",
        "| map | made from | unit |",
        "| --- | --- | --- |",
    ]
    for name in sorted(made):
        lines.append(f"| `{name}` | {', '.join(made[name])} | {MAP_UNITS.get(name, '')} |")
    return "\n".join(
        [*lines, "", "Maps without a unit here state theirs in `appearance.json`.", ""]
    )


# bibliography ------------------------------------------------------------------------------------


def citations_table() -> str:
    """Return the works that the code cites by their DOI, with the files that cite them."""
    names: dict[str, Counter[str]] = {}
    files: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix not in (".py", ".csv", ".toml"):
                continue
            text = re.sub(r"\s+", " ", re.sub(r"\n\s*#?", " ", path.read_text("utf-8")))
            for match in DOI.finditer(text):
                doi = match[0]
                if doi.endswith(")") and doi.count(")") > doi.count("("):
                    doi = doi[: doi.rindex(")")]
                found = AUTHORS.findall(text[max(0, match.start() - 220) : match.start()])
                work = names.setdefault(doi, Counter())
                if found:
                    work[" ".join(found[-1])] += 1
                name = path.relative_to(ROOT).as_posix()
                if name not in files.setdefault(doi, []):
                    files[doi].append(name)
    works = {doi: WORKS.get(doi) or names[doi].most_common(1)[0][0] for doi in files}
    lines = ["| work | DOI | cited in |", "| --- | --- | --- |"]
    for doi in sorted(files, key=lambda doi: works[doi]):
        listed = ", ".join(f"`{name}`" for name in files[doi][:4])
        more = f" and {len(files[doi]) - 4} more" if len(files[doi]) > 4 else ""
        lines.append(f"| {works[doi]} | [{doi}](https://doi.org/{doi}) | {listed}{more} |")
    return "\n".join(lines)
