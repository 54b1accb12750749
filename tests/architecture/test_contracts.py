"""The structure that the design promises, checked on the code itself."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from fixtures.product_code import PACKAGES, ROOT, modules, nodes_of, text_of, tree_of

COMPARISONS = {"all", "any", "allclose", "isclose", "array_equal"}
BEGINS_LIKE_ONE = re.compile(
    rf"^(?! *(?:assert|return|if|elif|while|for|yield)\b)[^#\n]*\.({'|'.join(COMPARISONS)})\(",
    re.MULTILINE,
)


def test_import_contracts_hold():
    tool = Path(sys.executable).with_name("lint-imports")
    run = subprocess.run([tool, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-3000:]


def bare_comparisons(text):
    if not BEGINS_LIKE_ONE.search(text):
        return []  # most files are spared the parsing
    return [
        node.lineno
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Call)
        and isinstance(node.value.func, ast.Attribute)
        and node.value.func.attr in COMPARISONS
    ]


def test_no_test_compares_without_an_assertion():
    found = [f"{p}:{line}" for p in modules("tests") for line in bare_comparisons(text_of(p))]
    assert not found


@pytest.mark.parametrize("bare", ["np.allclose(a, b)", "(a == b).all()", "np.all(\n    a\n)"])
def test_a_comparison_without_an_assertion_would_be_found(bare):
    assert bare_comparisons(f"{bare}\nassert np.allclose(a, b)") == [1]


def aliases_with_none(tree):
    """The names a module gives to types that admit None, at its top level."""
    return {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign)
        and any(isinstance(n, ast.Constant) and n.value is None for n in ast.walk(node.value))
        for target in node.targets
        if isinstance(target, ast.Name)
    }


@cache
def aliases_of_module(path):
    return aliases_with_none(tree_of(path)) if path.exists() else set()


def imported_aliases_with_none(tree):
    """Those it imports from modules of ours, under the names it uses."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
            folder = ROOT.joinpath(*node.module.split("."))
            there = aliases_of_module(folder.with_suffix(".py"))
            for alias in node.names:
                name = alias.asname or alias.name
                found |= {name} if alias.name in there else set()
                found |= {f"{name}.{n}" for n in aliases_of_module(folder / f"{alias.name}.py")}
    return found


def none_defaults_without_none(tree):
    found = []
    aliases = sorted(aliases_with_none(tree) | imported_aliases_with_none(tree))
    allowed = re.compile("|".join([r"None", r"Any", r"object", *(rf"\b{a}\b" for a in aliases)]))
    for node in nodes_of(tree, ast.FunctionDef, ast.AsyncFunctionDef):
        args = node.args
        positional = [*args.posonlyargs, *args.args]
        pairs = list(
            zip(positional[len(positional) - len(args.defaults) :], args.defaults, strict=True)
        ) + [(a, d) for a, d in zip(args.kwonlyargs, args.kw_defaults, strict=True) if d]
        found += [
            f"{node.name}.{arg.arg}"
            for arg, default in pairs
            if isinstance(default, ast.Constant)
            and default.value is None
            and arg.annotation is not None
            and not allowed.search(ast.unparse(arg.annotation))
        ]
    return found


def test_a_default_of_none_shows_in_the_annotation():
    found = [
        f"{p.relative_to(ROOT)}: {name}"
        for p in modules(*PACKAGES)
        for name in none_defaults_without_none(tree_of(p))
    ]
    assert not found


def test_a_hidden_none_would_be_found():
    imports = "from skinrig.command_line.options import Json, Site\n"
    modules_alone = "from skinrig.command_line import options\n"
    for code in (
        "def f(a: int = None, b: int | None = None): ...",
        imports + "def f(a: Json = None, b: Site = None): ...",
        modules_alone + "def f(a: options.Json = None, b: options.Site = None): ...",
    ):
        assert none_defaults_without_none(ast.parse(code)) == ["f.a"]


APPLICATION_IN_STRING = re.compile(
    r"""["']skinrig\.(?:[\w.{}]*["']|\w*\{)"""  # a module's name, or its beginning
    r"""|(?:import_module|__import__|find_spec|run_module)\(\s*[fF]?["']skinrig\b"""
    r"""|-m(?:["'],)?\s*["']?skinrig\b"""  # as a command
)
"""A name that an import at run time needs; schemas, versions and advice have others."""


def imports_by_name(text):
    return "skinrig" in text and APPLICATION_IN_STRING.search(text) is not None


def test_packages_do_not_import_application_by_name():
    """The import contracts cover ``import skinrig``; a module's name in a string is another way."""
    paths = modules("capture", "reconstruction", "rigsim", "model")
    assert len(paths) > 400
    assert [p for p in paths if imports_by_name(text_of(p))] == []


@pytest.mark.parametrize(
    "code",
    [
        'import_module("skinrig.cli")',
        'importlib.import_module(\n    "skinrig"\n)',
        "__import__('skinrig')",
        'import_module(f"skinrig.{name}")',
        'import_module("skinrig." + name)',
        'names = ["skinrig.fusing.faces"]',
        'run([sys.executable, "-m", "skinrig", *words])',
        'run("python -m skinrig doctor", shell=True)',
    ],
)
def test_import_of_application_by_name_is_found(code):
    assert imports_by_name(code)


@pytest.mark.parametrize(
    "code", ['SCHEMA = "skinrig.rig/1"', 'version("skinrig")', 'ADVICE = "skinrig verify lists it"']
)
def test_other_uses_of_the_name_are_allowed(code):
    assert not imports_by_name(code)


@pytest.mark.long
def test_packages_load_without_the_application():
    """Each module of the four packages is imported where ``skinrig`` cannot be."""
    names = [
        ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for p in modules("capture", "reconstruction", "rigsim", "model")
    ]
    code = (
        "import importlib, sys, warnings\n"
        "warnings.simplefilter('ignore')\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'skinrig':\n"
        "            raise ImportError('the application was imported')\n"
        "sys.meta_path.insert(0, Refuse())\n"
        f"for name in {names!r}:\n"
        "    try:\n"
        "        importlib.import_module(name)\n"
        "    except ImportError as error:\n"
        "        assert 'application' not in str(error), name\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]


def test_capture_has_no_branch_for_simulation():
    found = [
        f"{p.relative_to(ROOT)}:{node.lineno}"
        for p in modules("capture")
        for node in nodes_of(tree_of(p), ast.If)
        if re.search(r"[=!]= 'simulated'|\bis_?simulat|\.simulat", ast.unparse(node.test))
    ]
    assert not found


def test_tracked_files_omit_machine_paths_and_package_index():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    index = re.compile(r"(index-url|find-links)|https?://[^ \"']*/(simple|packages)/")
    places = [str(ROOT.parent) + "/", str(Path.home()) + "/"]
    places = [place for place in places if len(place) > 2]
    own = Path(__file__).resolve()
    found = []
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.suffix in {".npz", ".exr", ".png"} or path.resolve() == own or not path.is_file():
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        if index.search(text) or any(place in text for place in places):
            found.append(name)
    assert not found


@pytest.mark.parametrize("package", PACKAGES)
def test_module_names_are_descriptive(package):
    empty_names = {"utils", "util", "helpers", "helper", "common", "core", "manager", "misc"}
    assert not [p for p in modules(package) if p.stem.strip("_") in empty_names]


@pytest.mark.parametrize("package", PACKAGES)
def test_package_files_hold_no_logic(package):
    long = [
        p for p in (ROOT / package).rglob("__init__.py") if len(p.read_text().splitlines()) > 40
    ]
    assert not long
