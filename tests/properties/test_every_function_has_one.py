"""Every public function of `model` and `reconstruction` is driven by a property, or says why not.

A function counts as driven when a test under `@given`, or a helper in the same file that such a
test calls, names it through its module. The names are read from the sources: nothing is imported,
and a list that names a function that is gone, or one that is driven after all, fails as well.
"""

import ast
from functools import lru_cache

import pytest
from fixtures.product_code import ROOT, modules, tree_of

PACKAGES = ("model", "reconstruction")

FILES = "reads or writes files; tests/unit and tests/faults damage them"
SESSION = "a stage of a session, whose inputs are files; tests/recovery and tests/system"
RENDERED = "needs pictures or faces that fit each other; tests/recovery hold it to the truth"
FITTED = "a fit of seconds to minutes; tests/unit and tests/recovery hold it to its truth"
WHOLE = "takes a whole appearance or scan; tests/unit and tests/recovery make them"
INNER = "a step inside functions that are driven; it takes what they have checked"
WORDS = "names, words or constants: no numerical argument"

LEAST_DRIVEN = 340
"""What there is now: it may only get better."""

NOT_DRIVEN = {
    f"{module}.{name}": reason
    for reason, modules in (
        (
            FILES,
            {
                "model.brdf.tables": "load",
                "model.facial_color.document": "from_maps_and_document to_maps",
                "model.merl": "read read_mean write",
                "model.brdf.rgl": "read write",
                "model.store": "read read_document read_exr require_free write write_exr",
                "model.brdf.tensor_file": "read write",
                "model.traits.storage": "from_bytes load",
                "model.wrinkles.expressions": "read_table",
                "reconstruction.correspondence.landmark_table": "read",
                "reconstruction.scan.mesh": "load_ply",
                "reconstruction.pipeline.flash.state_images": "read",
                "reconstruction.subsurface.probe_sites": "read_landmarks",
            },
        ),
        (
            SESSION,
            {
                "reconstruction.pipeline.dome.calibrated": (
                    "calibrated reorder_lights seen_from split_exposures"
                ),
                "reconstruction.pipeline.dome.motion": "follow_head",
                "reconstruction.pipeline.dome.registration": "farthest_point_sample register",
                "reconstruction.pipeline.dome.lobes": "fit_lobes refine_normals weight_names",
                "reconstruction.pipeline.dome.stages": "graph maps_of",
                "reconstruction.pipeline.flash.facial_color": (
                    "alignment_document fit repeats_document"
                ),
                "reconstruction.pipeline.flash.stages": (
                    "colors_of_skin diffuse_of_each graph rig_of stderr_of"
                ),
                "reconstruction.pipeline.gradient.stages": "graph products",
                "reconstruction.pipeline.recipes": "light_list recipe_of reconstruct",
                "reconstruction.pipeline.probe.images": "measurement_name",
                "reconstruction.pipeline.probe.profile_fits": (
                    "fit_profiles profile_groups site_values"
                ),
                "reconstruction.pipeline.probe.stages": "graph products",
                "reconstruction.pipeline.flash.sequence_blood": "blood_of_discs",
                "reconstruction.pipeline.flash.sequence": "graph products",
                "reconstruction.pipeline.gradient.skin_strain": "measure_states skin_mask",
                "reconstruction.pipeline.light_stack": "graph",
                "reconstruction.pipeline.masked_map": "masked_map",
                "reconstruction.pipeline.graph": (
                    "attributes_of document_bytes input_hashes order record run stage_maker"
                ),
            },
        ),
        (
            RENDERED,
            {
                "reconstruction.correspondence.common_parameterization": (
                    "correspond find_cylinder frame_around"
                ),
                "reconstruction.correspondence.charts": "chart closed outermost splat",
                "reconstruction.correspondence.common_regions": "region standard_frame",
                "reconstruction.correspondence.expression_alignment": "align",
                "reconstruction.registration.feature_matches": "match",
                "reconstruction.gradient_normals.moments": "prepare with_filter with_shared_dark",
                "reconstruction.gradient_normals.noise": "estimate_noise",
                "reconstruction.gradient_normals.estimation": "estimate_roughness from_patterns",
                "reconstruction.registration.head_motion": "estimate",
                "reconstruction.lumitexels.samples": "visibility",
                "reconstruction.surface.model_normals": "estimate",
                "reconstruction.facial_color.rig_transfer": "transfer_rig",
                "reconstruction.scan.registration": "align register",
                "reconstruction.scan.rough_normals": "photometric_normals",
                "reconstruction.registration.strain": "measure_strain",
                "reconstruction.surface.errors": "of_albedo of_normals",
                "reconstruction.surface.estimates": (
                    "albedo at_normals lobe_weights "
                    "normals_from_all_light normals_from_half_vectors "
                    "normals_from_remainder normals_from_shading "
                    "rows_of sample_counts seen_enough surface_samples "
                    "transmitted"
                ),
            },
        ),
        (
            FITTED,
            {
                "model.displacement_synthesis.growth": "grow lay_out",
                "model.brdf.rgl": "of_brdf",
                "reconstruction.brdf_basis.space": "curve",
                "reconstruction.kernel_fit.errors": (
                    "nearly_as_good of_grid of_kernel widths_of_best widths_of_pair"
                ),
                "reconstruction.chromophores.face": (
                    "estimate_face fit_face_distribution fit_with_white_reference"
                ),
                "reconstruction.chromophores.face_distribution": "fit",
                "reconstruction.kernel_fit.outcome": "summarize_search",
                "reconstruction.kernel_fit.search": "exhaustive gentlest hierarchical",
                "reconstruction.kernel_fit.neutral_relief": "convolved relief_of",
                "reconstruction.facial_color.shared_melanin": "estimate_shared_melanin",
                "reconstruction.wrinkles.fit": "differences fit fit_weights",
                "reconstruction.wrinkles.weights": "equations_of zone_weights",
                "reconstruction.wrinkles.zones": "amplitudes fit_zones",
            },
        ),
        (
            WHOLE,
            {
                "model.skin_reflectance": "assemble lobes_of",
                "reconstruction.scan.repair": "repair",
                "reconstruction.scan.mesh": "prepare refine unwrap",
            },
        ),
        (
            INNER,
            {
                "model.brdf.recipe": "materials",
                "model.vectors": "unit_vectors",
                "reconstruction.gradient_normals.inversion": "places_of views_of",
                "reconstruction.checks": "require_settings require_shapes",
                "reconstruction.polarization": "fresnel_amplitudes",
                "reconstruction.scan.repair": "directed_edges",
                "reconstruction.gradient_normals.sphere_lights": (
                    "require_finite require_unit_vectors"
                ),
                "model.facial_color.basis": "fitted transferred",
                "model.texture_statistics.space": "weight_of",
                "reconstruction.chromophores.lines": "lines_of",
                "reconstruction.chromophores.pixel_checks": (
                    "broadcast_variance checked_mask usable_colors"
                ),
                "reconstruction.chromophores.start": "start_for",
                "reconstruction.subsurface.nearest": "fit_nearest",
                "reconstruction.subsurface.profile_batch": "fit_from",
                "reconstruction.subsurface.profile_fit": "fit_profiles",
                "reconstruction.anisotropy.profile_anisotropy": "compare",
                "reconstruction.subsurface.models": "profile_model",
                "reconstruction.subsurface.outcome": "evaluate_fits",
            },
        ),
        (
            WORDS,
            {
                "model.brdf.tables": "default nodes",
                "model.facial_color.state_maps": "check_name",
                "model.microstructure.kernel_table": "forehead_points",
                "model.photon_table.medium": "root_spline_matrix",
                "model.skin_reflectance": "population_mean_mm",
                "model.traits.storage": "default",
                "model.traits.vectors": "doubts",
                "model.translucency_population": "weyrich_2005",
                "model.wrinkles.expressions": "as_table",
                "model.wrinkles.storage": "paper_footprint",
                "reconstruction.compiled": "given",
                "reconstruction.chromophores.model_error": "identity load shading_histogram",
            },
        ),
    )
    for module, names in modules.items()
    for name in names.split()
}


def product_modules():
    """Dotted name and syntax tree of each module of the packages."""
    for path in modules(*PACKAGES):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        yield name.removesuffix(".__init__"), tree_of(path)


@lru_cache(maxsize=1)
def public_functions():
    found = set()
    for module, tree in product_modules():
        if module.rpartition(".")[2].endswith("kernels"):
            continue  # compiled loops: Python calls them through the functions listed
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


def modules_of(tree):
    """Local name to module, or to function where one is imported by itself."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
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
        if "@given" in path.read_text(encoding="utf-8"):
            found |= driven_by(path)
    return {defined_at(name) for name in found} & public_functions()


def test_every_public_function_is_driven_over_its_domain_or_says_why_not():
    silent = public_functions() - driven() - NOT_DRIVEN.keys()
    assert not silent, "\n".join(sorted(silent))


def test_no_reason_is_given_for_what_is_driven_or_gone():
    stale = NOT_DRIVEN.keys() - (public_functions() - driven())
    assert not stale, "\n".join(sorted(stale))


@pytest.mark.parametrize("name", ["model.dipole.profile.reflectance", "model.fresnel.reflectance"])
def test_a_function_that_a_test_is_parametrized_with_counts_as_driven(name):
    assert name in driven()


def test_most_functions_are_driven():
    assert len(driven()) >= LEAST_DRIVEN
