"""Modules and functions stay small enough to be read: bounds, and what exceeds them today."""

import ast

from fixtures.product_code import PACKAGES, ROOT, functions, modules, text_of

MAX_LINES = 450
MAX_FUNCTION_LINES = 80
MAX_PARAMETERS = 12

LONG_FUNCTIONS = {
    "rigsim/tissue/photon_lanes.py:_run": 165,
    "rigsim/tissue/photon_lanes.py:body": 111,
}
"""Compiled in other words, with their present size, which may only fall."""


def long_modules(root):
    counts = {
        path.relative_to(root).as_posix(): len(text_of(path).splitlines())
        for path in modules(*PACKAGES, root=root)
    }
    return {name: count for name, count in counts.items() if count > MAX_LINES}


def is_compiled(function):
    return any("jit" in ast.unparse(mark) for mark in function.decorator_list)


def lines_of(function):
    """Lines of a function without its docstring."""
    first = function.body[0]
    doc = 0
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
        doc = first.end_lineno - first.lineno + 1
    return function.end_lineno - function.lineno + 1 - doc


def parameters_of(function):
    a = function.args
    return len([*a.posonlyargs, *a.args, *a.kwonlyargs]) - (
        bool(a.args) and a.args[0].arg in ("self", "cls")
    )


def large_functions(root, size, bound):
    return {
        f"{name}:{function.name}": size(function)
        for name, function in functions(root)
        if size(function) > bound and not is_compiled(function)
    }


def grown(found, known):
    """What exceeds its bound and is not known to, or has grown; what is known and is gone."""
    return {n: c for n, c in found.items() if c > known.get(n, 0)}, known.keys() - found.keys()


def test_no_module_is_too_long():
    assert long_modules(ROOT) == {}


def test_no_function_is_too_long():
    found = large_functions(ROOT, lines_of, MAX_FUNCTION_LINES)
    assert grown(found, LONG_FUNCTIONS) == ({}, set())


def test_no_function_takes_too_many_parameters():
    assert large_functions(ROOT, parameters_of, MAX_PARAMETERS) == {}


def test_size_check_finds_oversized_modules_and_functions(tmp_path):
    (tmp_path / "model").mkdir()
    arguments = ", ".join(f"a{n}" for n in range(MAX_PARAMETERS + 1))
    body = "".join(f"    x = {n}\n" for n in range(MAX_LINES))
    for name, mark in (("plain", ""), ("kernels", "@njit(cache=True)\n")):
        text = f'{mark}def f(self, {arguments}):\n    """Do it.\n\n    Well.\n    """\n{body}'
        (tmp_path / "model" / f"{name}.py").write_text(text)
    assert long_modules(tmp_path) == {
        "model/plain.py": MAX_LINES + 5,
        "model/kernels.py": MAX_LINES + 6,
    }
    functions = large_functions(tmp_path, lines_of, MAX_FUNCTION_LINES)
    assert functions == {"model/plain.py:f": MAX_LINES + 1}
    wide = large_functions(tmp_path, parameters_of, MAX_PARAMETERS)
    assert wide == {"model/plain.py:f": MAX_PARAMETERS + 1}
    assert grown({"a": 2, "b": 5}, {"a": 3, "c": 9}) == ({"b": 5}, {"c"})
