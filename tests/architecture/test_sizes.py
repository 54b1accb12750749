"""Modules and functions stay small enough to be read: bounds, and what exceeds them today."""

import ast

from fixtures.product_code import PACKAGES, ROOT, functions, modules, text_of

MAX_LINES = 450
MAX_FUNCTION_LINES = 80
MAX_PARAMETERS = 12

LONG_MODULES = {
    "reconstruction/brdf_basis/nnls_kernels.py": 568,
    "reconstruction/chromophores/posterior_kernels.py": 633,
    "reconstruction/correspondence/common_parameterization.py": 554,
    "reconstruction/facial_color/repeatability.py": 457,
    "reconstruction/scan/registration.py": 502,
    "rigsim/boxes/caliper.py": 493,
    "rigsim/boxes/controller.py": 465,
    "rigsim/light/olat.py": 625,
    "rigsim/population/population.py": 487,
    "rigsim/scenes/flash/scene.py": 503,
    "rigsim/scenes/gradient/scene.py": 533,
    "rigsim/shading.py": 500,
    "rigsim/skin_patch/stretch.py": 458,
    "skinrig/benchmarks/gradient_rig/microstructure.py": 574,
    "skinrig/editing/edit.py": 475,
    "skinrig/rendering/figures.py": 456,
}
LONG_FUNCTIONS = {
    "model/displacement_synthesis/growth.py:_choose": 89,
    "reconstruction/anisotropy/estimation.py:estimate": 96,
    "reconstruction/anisotropy/profile_anisotropy.py:estimate_from_profiles": 87,
    "reconstruction/chromophores/face_distribution.py:fit": 84,
    "reconstruction/diffuse_albedo/estimation.py:estimate": 94,
    "reconstruction/facial_color/shared_melanin.py:estimate_shared_melanin": 115,
    "reconstruction/kernel_fit/outcome.py:summarize_search": 87,
    "reconstruction/photometric_stereo/kernels.py:_fit_points": 92,
    "reconstruction/pipeline/flash/facial_color.py:fit": 83,
    "rigsim/fiber/anisotropic_tissue.py:anisotropic_profile": 85,
    "rigsim/needs/dome.py:dome_needs": 82,
    "rigsim/needs/flash.py:flash_needs": 94,
    "rigsim/scenes/dome/scene.py:__init__": 94,
    "rigsim/tissue/photon_lanes.py:_run": 188,
    "rigsim/tissue/photon_lanes.py:body": 131,
    "skinrig/applying/relief.py:__call__": 85,
    "skinrig/benchmarks/dome/brdf.py:surface": 83,
    "skinrig/benchmarks/dome/editing.py:editing": 85,
    "skinrig/benchmarks/dome/rendering.py:model": 99,
    "skinrig/benchmarks/dome/surface.py:lumitexels": 82,
    "skinrig/benchmarks/dome/traits.py:_albedo": 87,
    "skinrig/benchmarks/figures.py:error_against_seconds": 90,
    "skinrig/benchmarks/flash_rig/alignment.py:aligned": 103,
    "skinrig/benchmarks/flash_rig/facial_color.py:rig": 100,
    "skinrig/benchmarks/gradient_rig/microstructure.py:truth": 106,
    "skinrig/benchmarks/probe/subsurface.py:batches": 90,
    "skinrig/benchmarks/probe/subsurface.py:tiers": 106,
    "skinrig/benchmarks/probe/translucency.py:sites": 84,
    "skinrig/commands/export.py:export": 134,
    "skinrig/commands/rendering.py:render": 157,
    "skinrig/commands/showing.py:view": 81,
    "skinrig/exporting/sessions/stokes.py:_write": 92,
}
MANY_PARAMETERS = {
    "model/displacement_synthesis/growth.py:lay_out": 13,
    "model/texture_statistics/description.py:match": 13,
    "reconstruction/anisotropy/profile_anisotropy.py:estimate_from_profiles": 15,
    "reconstruction/gradient_normals/estimation.py:from_patterns": 14,
    "reconstruction/kernel_fit/fit.py:fit_kernel": 17,
    "reconstruction/photometric_stereo/kernels.py:_fit_points": 16,
    "reconstruction/photometric_stereo/refinement.py:_judged": 13,
    "reconstruction/pipeline/recipes.py:reconstruct": 13,
    "rigsim/boxes/probe.py:__init__": 14,
    "rigsim/scenes/dome/scene.py:__init__": 13,
    "rigsim/scenes/gradient/scene.py:__init__": 13,
    "rigsim/tissue/photon_lanes.py:body": 15,
    "skinrig/commands/dynamic.py:apply_expression": 17,
    "skinrig/commands/editing.py:edit": 13,
    "skinrig/commands/export.py:export": 18,
    "skinrig/commands/rendering.py:render": 26,
    "skinrig/rendering/render.py:render": 13,
}
"""What a bound does not fit yet, with its present size, which may only fall."""


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
    assert grown(long_modules(ROOT), LONG_MODULES) == ({}, set())


def test_no_function_is_too_long():
    found = large_functions(ROOT, lines_of, MAX_FUNCTION_LINES)
    assert grown(found, LONG_FUNCTIONS) == ({}, set())


def test_no_function_takes_too_many_parameters():
    found = large_functions(ROOT, parameters_of, MAX_PARAMETERS)
    assert grown(found, MANY_PARAMETERS) == ({}, set())


def test_what_is_too_large_would_be_found(tmp_path):
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
