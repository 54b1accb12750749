"""The graph of all imports: no circle, no crowded folder, and contracts that a breach breaks."""

import ast
import graphlib
import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from fixtures.product_code import PACKAGES, ROOT, modules, nodes_of, tree_of

MAX_MODULES = 15
LINT_IMPORTS = Path(sys.executable).with_name("lint-imports")


@pytest.fixture
def product_copy(tmp_path):
    """The packages' sources and the contracts, to be broken."""
    for package in PACKAGES:
        leave = shutil.ignore_patterns("__pycache__", "data", "js", "glsl")
        shutil.copytree(ROOT / package, tmp_path / package, ignore=leave)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def import_graph(root):
    """Modules with what each imports: at its top, inside functions and for types alone."""
    script = (
        "import grimp, json, sys\n"
        f"graph = grimp.build_graph(*{PACKAGES!r}, cache_dir=None)\n"
        "found = {m: sorted(graph.find_modules_directly_imported_by(m)) for m in graph.modules}\n"
        "json.dump(found, sys.stdout)\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def circle_in(graph):
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_imports_form_no_circle():
    graph = import_graph(ROOT)
    assert len(graph) > 500
    assert circle_in(graph) == []


def test_circles_would_be_found(tmp_path):
    """Of imports at the top, inside a function and for types alone, in three packages."""
    imports = {
        "rigsim": "from rigsim.two import one\n",
        "model": "def later():\n    from model.two import one\n",
        "capture": "if TYPE_CHECKING:\n    from capture.two import one\n",
    }
    for package in PACKAGES:
        folder = tmp_path / package / "two"
        folder.mkdir(parents=True)
        (folder.parent / "__init__.py").touch()
        (folder / "__init__.py").touch()
        (folder / "one.py").write_text(f"from {package} import back\n")
        (folder.parent / "back.py").write_text(imports.get(package, ""))
    graph = import_graph(tmp_path)
    for package in PACKAGES:
        own = {name: to for name, to in graph.items() if name.startswith(package)}
        circle = {f"{package}.back", f"{package}.two.one"} if package in imports else set()
        assert set(circle_in(own)) == circle


def crowded(root):
    paths = (p.relative_to(root) for package in PACKAGES for p in (root / package).rglob("*.py"))
    modules = Counter(path.parent.as_posix() for path in paths if path.name != "__init__.py")
    return {n: count for n, count in modules.items() if count > MAX_MODULES}


def test_no_folder_is_crowded():
    assert crowded(ROOT) == {}


def test_a_crowded_folder_would_be_found(tmp_path):
    folder = tmp_path / "model" / "dipole"
    folder.mkdir(parents=True)
    for number in range(MAX_MODULES + 1):
        (folder / f"m{number}.py").touch()
    assert crowded(tmp_path) == {"model/dipole": MAX_MODULES + 1}


def relative_imports(root):
    return [
        f"{path.relative_to(root)}:{node.lineno}"
        for path in modules(*PACKAGES, root=root)
        for node in nodes_of(tree_of(path), ast.ImportFrom)
        if node.level
    ]


def test_every_import_is_absolute():
    assert relative_imports(ROOT) == []


def test_a_relative_import_would_be_found(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "skin.py").write_text("from . import store\n")
    assert relative_imports(tmp_path) == ["model/skin.py:1"]


BREACHES = {
    "the packages stand on each other in one direction": ("model/skin.py", "import capture.rig"),
    "layers inside capture": ("capture/plan/dome.py", "import capture.session"),
    "layers inside reconstruction": (
        "reconstruction/chromophores/start.py",
        "import reconstruction.registration.strain",
    ),
    "estimators import the model and nothing else of ours": (
        "reconstruction/surface/errors.py",
        "import capture.rig",
    ),
    "layers inside model": ("model/fresnel.py", "import model.brdf.tables"),
    "the model stays light": ("model/traits/space.py", "import sklearn"),
    "layers inside rigsim": ("rigsim/boxes/faults.py", "import rigsim.targets.flat"),
    "no inverse crime": ("rigsim/light/led_light.py", "import model.fresnel"),
    "the renderer is imported in one place": ("rigsim/render/rays.py", "import mitsuba"),
    "drivers alone open serial ports": ("capture/plan/dome.py", "import serial"),
}


def lint(root):
    """Return what is reported of each contract that is broken."""
    run = subprocess.run([LINT_IMPORTS, "--no-cache"], cwd=root, capture_output=True, text=True)
    names = re.findall(r"^(.+) BROKEN", run.stdout, re.MULTILINE)
    assert bool(names) == bool(run.returncode), run.stdout + run.stderr
    parts = run.stdout.split("Broken contracts")[-1]
    headed = re.split(rf"^({'|'.join(map(re.escape, names))})\n-+$", parts, flags=re.MULTILINE)
    return dict(zip(headed[1::2], headed[2::2], strict=True))


def test_each_breach_breaks_its_contract(product_copy):
    for name, text in BREACHES.values():
        with (product_copy / name).open("a") as file:
            file.write(f"\n{text}\n")
    broken = lint(product_copy)
    assert len(broken) == len(BREACHES)
    for contract, (name, text) in BREACHES.items():
        (report,) = (found for start, found in broken.items() if start.startswith(contract))
        importer = name.removesuffix(".py").replace("/", ".")
        assert re.search(rf"{importer} -> {text.removeprefix('import ')}\b", report), report


def test_modules_outside_layers_break_contracts(product_copy):
    """Deny by default: the contracts list what is allowed, not what is forbidden."""
    for package in ("capture", "reconstruction", "model", "rigsim"):
        (product_copy / package / "helpers.py").write_text('"""In no layer."""\n')
    with (product_copy / "rigsim" / "light" / "led_light.py").open("a") as file:
        file.write("\nimport model.helpers\n")
    *layers, crime = sorted(lint(product_copy))
    packages = [name.removeprefix("layers inside ").partition(":")[0] for name in layers]
    assert packages == ["capture", "model", "reconstruction", "rigsim"]
    assert crime.startswith("no inverse crime")


def test_each_contract_has_a_breach():
    named = (ROOT / "pyproject.toml").read_text("utf-8").split("[[tool.importlinter.contracts]]")
    names = [text.split('name = "')[1].split('"')[0] for text in named[1:]]
    assert [sum(name.startswith(contract) for contract in BREACHES) for name in names] == [1] * 10
