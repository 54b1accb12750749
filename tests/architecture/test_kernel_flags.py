"""Kernels that reorder sums give the same digits from the compiler as from the cache.

Numba optimizes a callee alone, and again inside its caller. A process that compiles runs the
first version, one that loads the caller from the cache the second. Reordering differs between
them unless the callee has no machine code of its own.
"""

import ast

import pytest
from fixtures.product_code import PACKAGES, modules, nodes_of, text_of, tree_of


def read_kernels(tree):
    """Return calls' names per kernel, and options of each kernel: name to AST or None."""
    calls, options = {}, {}
    for function in nodes_of(tree, ast.FunctionDef):
        for decorator in function.decorator_list:
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func).endswith("njit"):
                names = [c.func.id for c in ast.walk(function) if is_plain_call(c)]
                calls[function.name] = set(names)
                options[function.name] = {k.arg: k.value for k in decorator.keywords if k.arg}
    return calls, options


def is_plain_call(node):
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name)


def read_flags(tree):
    """Return module-level names whose value contains flags, with the value's text."""
    return {
        target.id: ast.unparse(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name) and "MATH" in target.id
    }


def reorders_sums(options, flags):
    text = ast.unparse(options["fastmath"]) if "fastmath" in options else ""
    for _ in range(3):  # names of names
        for name, value in flags.items():
            text = text.replace(name, value) if name in text.split() else text
    return text == "True" or "reassoc" in text


def is_inlined(options):
    return any(
        name in options and ast.unparse(options[name]) == text
        for name, text in (("inline", "'always'"), ("forceinline", "True"))
    )


def find_unsafe(trees):
    """Return kernels that reorder sums, are called by other kernels, and are not inlined."""
    unsafe = []
    flags = [read_flags(tree) for tree in trees]
    shared = {name: value for own in flags for name, value in own.items() if name[0] != "_"}
    kernels = [read_kernels(tree) for tree in trees]
    called = set().union(*(names for calls, _ in kernels for names in calls.values()))
    for own, (_, options) in zip(flags, kernels, strict=True):
        unsafe += [
            name
            for name, given in options.items()
            if name in called and reorders_sums(given, shared | own) and not is_inlined(given)
        ]
    return unsafe


def test_kernels_reordering_sums_are_inlined_in_callers():
    trees = [tree_of(path) for path in modules(*PACKAGES) if "njit" in text_of(path)]
    assert len(trees) > 20
    assert find_unsafe(trees) == []


@pytest.mark.parametrize(
    ("flags", "unsafe"),
    [
        ("fastmath=True", True),
        ('fastmath={"reassoc"}', True),
        ("fastmath=FAST_MATH | {'nnan'}", True),
        ("fastmath=FAST_MATH, forceinline=True", False),
        ('fastmath={"contract"}', False),
    ],
)
def test_reordering_callee_is_found_unless_inlined(flags, unsafe):
    text = f"""
FAST_MATH = {{"reassoc", "nsz"}}
@njit({flags})
def add(x): ...
@njit(cache=True)
def run(x): add(x)
"""
    assert find_unsafe([ast.parse(text)]) == (["add"] if unsafe else [])
