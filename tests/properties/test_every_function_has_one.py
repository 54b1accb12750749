"""Every public function of `model` and the estimators is driven by a property, or judged by name.

A function counts as driven when a test under `@given`, or a helper in the same file that such a
test calls, names it through its module. What is not driven another test names, or is called by
what is driven or named. The stages of `reconstruction.pipeline` take sessions, and are left to
tests/recovery and tests/system. The names are read from the sources: nothing is imported.
"""

import ast
import re
from functools import cache, lru_cache

import pytest
from fixtures.product_code import ROOT, modules, nodes_of, text_of, tree_of

PACKAGES = ("model", "reconstruction")
STAGES = "reconstruction.pipeline."
MIN_DRIVEN_SHARE = 0.70
"""Of the public functions, what properties drive now: it may only get better."""


def product_modules():
    """Dotted name and syntax tree of each module of the packages."""
    for path in modules(*PACKAGES):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        yield name.removesuffix(".__init__"), tree_of(path)


@lru_cache(maxsize=1)
def public_functions():
    found = set()
    for module, tree in product_modules():
        if module.rpartition(".")[2].endswith("kernels") or f"{module}.".startswith(STAGES):
            continue  # compiled loops are called through Python's functions
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
                continue
            if any("jit" in ast.unparse(mark) for mark in node.decorator_list):
                continue
            found.add(f"{module}.{node.name}")
    return found


@lru_cache(maxsize=1)
def re_exports():
    """Name under which a module imports a function, to the name where it is defined."""
    return {
        f"{module}.{local}": name
        for module, tree in product_modules()
        for local, name in modules_of(tree).items()
    }


def defined_at(name):
    while name in re_exports():
        name = re_exports()[name]
    return name


@cache
def modules_of(tree):
    """Local name to module, or to function where one is imported by itself."""
    names = {}
    for node in nodes_of(tree, ast.ImportFrom):
        if node.module:
            for alias in node.names:
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return names


def driven_by(path):
    """Functions that tests under `@given` in one file name."""
    tree = tree_of(path)
    names = modules_of(tree)
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    tables = {
        target.id: node
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    todo = [
        node
        for node in functions.values()
        if any("given" in ast.unparse(mark) for mark in node.decorator_list)
    ]
    done, found = set(), set()
    while todo:
        node = todo.pop()
        if id(node) in done:
            continue
        done.add(id(node))
        for part in ast.walk(node):
            if isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
                if part.value.id in names:
                    found.add(f"{names[part.value.id]}.{part.attr}")
            elif isinstance(part, ast.Name):
                if part.id in names:
                    found.add(names[part.id])
                todo += [where[part.id] for where in (functions, tables) if part.id in where]
    return found


@lru_cache(maxsize=1)
def driven():
    found = set()
    for path in sorted((ROOT / "tests").glob("**/test_*.py")):
        if "@given" in text_of(path):
            found |= driven_by(path)
    return {defined_at(name) for name in found} & public_functions()


def names_used(tree, names):
    """Functions that a tree names, by its imports: `names` as `modules_of` gives them."""
    found = set()
    for node in nodes_of(tree, ast.Attribute):
        if isinstance(node.value, ast.Name) and node.value.id in names:
            found.add(defined_at(f"{names[node.value.id]}.{node.attr}"))
    for node in nodes_of(tree, ast.Name):
        if node.id in names:
            found.add(defined_at(names[node.id]))
    return found


@lru_cache(maxsize=1)
def named_by_tests():
    imports = re.compile(r"^\s*from (model|reconstruction)\b", re.MULTILINE)
    trees = [tree_of(path) for path in modules("tests") if imports.search(text_of(path))]
    return set().union(*(names_used(tree, modules_of(tree)) for tree in trees))


@lru_cache(maxsize=1)
def named_in_bodies():
    """What each function's body names, by its name; by "" those of classes and private ones."""
    found = {"": set()}
    for module, tree in product_modules():
        own = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        names = modules_of(tree) | {name: f"{module}.{name}" for name in own}
        for node in tree.body:
            inner = isinstance(node, ast.ClassDef) or f"{module}.".startswith(STAGES)
            if inner or getattr(node, "name", "").startswith("_"):
                found[""] |= names_used(node, names)
            elif isinstance(node, ast.FunctionDef):
                found[f"{module}.{node.name}"] = names_used(node, names)
    return found


def called_by(functions):
    """What the bodies of `functions` name, and those of classes, private ones and stages."""
    named = named_in_bodies()
    return named[""].union(*(named[name] for name in functions & named.keys()))


def unjudged(public, known):
    """Those of `public` that are not known, nor called by what is, one after another."""
    silent = public - known
    while reached := silent & called_by(known):
        known, silent = known | reached, silent - reached
    return sorted(silent)


@pytest.mark.long
def test_public_functions_are_driven_over_domain_or_exempt():
    assert unjudged(public_functions(), driven() | named_by_tests()) == []


@pytest.mark.long
def test_function_without_test_is_found():
    lonely = "model.fresnel.nobody_calls_it"
    assert unjudged({lonely}, driven() | named_by_tests()) == [lonely]


@pytest.mark.parametrize("name", ["model.dipole.profile.reflectance", "model.fresnel.reflectance"])
def test_parametrized_function_counts_as_driven(name):
    assert name in driven()


def test_most_functions_are_driven():
    assert len(driven()) >= MIN_DRIVEN_SHARE * len(public_functions())
