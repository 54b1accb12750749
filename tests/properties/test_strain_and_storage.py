"""Strain in textures, sources of relief, stored wrinkles, pictures and compared kernels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import color_table_file, microstructure, wrinkles
from model.color_table import ColorTable
from model.displacement_synthesis import sources as synthesis_sources
from model.microstructure import mesh_strain, strain_fields
from model.microstructure.map_windows import MapWindow
from model.wrinkles import expressions as wrinkle_expressions
from model.wrinkles import storage as wrinkle_storage
from reconstruction.facial_color import perfusion_curves
from reconstruction.gradient_normals import channels as gradient_channels
from reconstruction.gradient_normals import patterns as gradient_patterns
from reconstruction.gradient_normals.channels import PatternSamples
from reconstruction.kernel_fit import table as kernel_table

CHEAP = settings(derandomize=True, deadline=None, max_examples=30, database=None)
FEW = settings(CHEAP, max_examples=10)

SEED = st.integers(0, 9999)
SIDES = st.tuples(st.integers(1, 9), st.integers(1, 9))
NO_NUMBER = st.sampled_from([np.nan, np.inf, -np.inf])


def stretched(stretch, scale=1.0):
    """Return a plane's strain with its faces and its texture, stretched along x."""
    y, x = np.mgrid[0:4, 0:4] / 3.0
    rest = scale * np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])
    corner = np.add.outer(4 * np.arange(3), np.arange(3)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 4], corner[:, None] + [1, 5, 4]])
    uv = np.column_stack([x.ravel(), y.ravel()])
    return mesh_strain.strain(rest, rest * [stretch, 1.0, 1.0], faces, uv), faces, uv


@CHEAP
@given(
    stretch=st.floats(0.01, 100.0),
    scale=st.floats(1e-3, 1e6),
    size=SIDES,
    window=st.tuples(SIDES, SIDES),
)
def test_strain_texture_is_the_same_in_every_window(stretch, scale, size, window):
    strain, faces, uv = stretched(stretch, scale)
    whole = strain_fields.rasterize(strain, faces, uv, size)
    assert whole.covered.all()
    np.testing.assert_allclose(whole.stretch[..., 0], max(stretch, 1.0), rtol=1e-5)
    np.testing.assert_allclose(whole.stretch[..., 1], min(stretch, 1.0), rtol=1e-5)
    lengths = np.linalg.norm(whole.axes, axis=-1)
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-5)
    assert (whole.px_per_mm > 0.0).all()
    top, left = (min(a, b) - 1 for a, b in zip(window[0], size, strict=True))
    bottom, right = (
        min(a + b + 1, c) for a, b, c in zip((top, left), window[1], size, strict=True)
    )
    part = strain_fields.rasterize(
        strain, faces, uv, size, window=MapWindow(top, bottom, left, right)
    )
    for name in ("stretch", "axes", "px_per_mm", "covered", "padded"):
        inside = getattr(whole, name)[top:bottom, left:right]
        np.testing.assert_array_equal(getattr(part, name), inside)
    with pytest.raises(mesh_strain.StrainError, match="window"):
        strain_fields.rasterize(strain, faces, uv, size, window=MapWindow(0, size[0] + 1, 0, 1))
    with pytest.raises(mesh_strain.StrainError, match="size"):
        strain_fields.rasterize(strain, faces, uv, (0, 3))


@CHEAP
@given(
    stretch=st.floats(0.01, 100.0),
    extrapolate=st.sampled_from(["hold", "formula"]),
    size=SIDES,
    share=st.floats(0.0, 1.0),
)
def test_strain_kernels_match_their_table(stretch, extrapolate, size, share):
    strain, faces, uv = stretched(stretch, 40.0)
    field = strain_fields.rasterize(strain, faces, uv, size)
    lines = strain_fields.line_kernels(field, extrapolate=extrapolate)
    for axis, line in enumerate(lines):
        alpha, sigma_um = microstructure.kernel_parameters(
            field.stretch[..., axis].astype(np.float64), extrapolate=extrapolate
        )
        np.testing.assert_allclose(line.alpha, alpha, atol=1e-4)
        assert ((line.alpha >= -2.0) & (line.alpha <= 1.0)).all()
        wide = 1e-3 * sigma_um * field.px_per_mm[..., axis]
        # on either side of 1 sigma is another line
        sure = np.abs(field.stretch[..., axis] - 1.0) > 1e-5
        np.testing.assert_allclose(line.sigma_px[sure], wide[sure], rtol=1e-4, atol=1e-9)
    weights = np.stack([np.full((2, 2), share), np.full((2, 2), 1.0 - share)])
    regions = strain_fields.KernelRegions((microstructure.FOREHEAD,) * 2, weights)
    mixed = strain_fields.regional_kernels(field, regions, size, extrapolate=extrapolate)
    for line, other in zip(lines, mixed, strict=True):
        np.testing.assert_allclose(other.alpha, line.alpha, atol=1e-6)
        np.testing.assert_allclose(other.sigma_px, line.sigma_px, rtol=1e-5, atol=1e-9)
    with pytest.raises(ValueError, match="extrapolate"):
        strain_fields.line_kernels(field, extrapolate="refuse")


@CHEAP
@given(
    seed=SEED,
    sides=st.lists(st.tuples(*[st.integers(2, 14)] * 2), min_size=1, max_size=3),
    zooms=st.lists(st.floats(0.2, 3.0), min_size=1, max_size=3),
    window=st.integers(1, 6),
    holes=st.booleans(),
)
def test_sources_contain_each_large_enough_patch_per_scale(seed, sides, zooms, window, holes):
    rng = np.random.default_rng(seed)
    patches = [rng.standard_normal(side) for side in sides]
    if holes:
        for patch in patches:
            patch[rng.uniform(size=patch.shape) < 0.3] = np.nan
            patch[0, 0] = 1.0
    scaled = [[tuple(max(1, int(n * z + 1e-9)) for n in side) for side in sides] for z in zooms]
    large = [[shape for shape in level if min(shape) >= window] for level in scaled]
    if not all(large):
        with pytest.raises(ValueError, match="patches"):
            synthesis_sources.gather_sources(patches, zooms, window=window, name="patches")
        return
    found = synthesis_sources.gather_sources(patches, zooms, window=window, name="patches")
    assert np.isfinite(found.heights).all()
    assert np.diff(found.level_first).tolist() == [len(level) for level in large]
    shapes = [shape for level in large for shape in level]
    np.testing.assert_array_equal(found.table[:, 1:3], shapes)
    assert found.heights.size == sum(h * w for h, w in shapes)
    for first, high, wide, entry, turned in found.table:
        patch = found.heights[first : first + high * wide].reshape(high, wide)
        other = found.transposed[turned : turned + high * wide].reshape(wide, high)
        np.testing.assert_array_equal(other, patch.T)
        table = found.filled[entry : entry + (high + 1) * (wide + 1)].reshape(high + 1, wide + 1)
        assert 0 <= table[-1, -1] <= high * wide
        assert holes or table[-1, -1] == 0


@CHEAP
@given(
    wrinkle=SIDES,
    mask=SIDES,
    zones=st.integers(1, 12),
    mips=st.booleans(),
    maps=st.sampled_from(["float32", "float16", "unit8", "bc5"]),
    masks=st.sampled_from(["float32", "float16", "unit8", "bc3"]),
)
def test_a_footprint_is_that_of_its_textures(wrinkle, mask, zones, mips, maps, masks):
    told = {"maps": maps, "masks": masks, "zones": zones, "mip_maps": mips}
    found = wrinkle_storage.footprint(wrinkle, mask, **told)
    assert found.wrinkle_bytes >= wrinkle[0] * wrinkle[1]
    assert found.mask_bytes % -(-zones // 4) == 0
    whole = found.wrinkle_bytes + found.mask_bytes
    assert found.total_bytes == pytest.approx(whole * (4 / 3 if mips else 1))
    for bad in ({"maps": "bc1"}, {"masks": "bc1"}, {"zones": 0}):
        with pytest.raises(wrinkle_expressions.WrinkleError):
            wrinkle_storage.footprint(wrinkle, mask, **(told | bad))
    with pytest.raises(wrinkle_expressions.WrinkleError):
        wrinkle_storage.footprint((0, 3), mask, **told)


@CHEAP
@given(
    seed=SEED,
    sides=SIDES,
    zones=st.integers(1, 9),
    huge=st.sampled_from([2.0, 1e5, 1e39]),
    encoding=st.sampled_from(["float32", "float16", "unit8", "bc3"]),
    bad=NO_NUMBER,
)
def test_stored_masks_come_back_or_are_refused(seed, sides, zones, huge, encoding, bad):
    masks = np.random.default_rng(seed).uniform(size=(zones, *sides))
    found = wrinkle_storage.round_trip_masks(masks, encoding)
    assert found.shape == masks.shape
    assert found.dtype == np.float32
    worst = {"float32": 1e-7, "float16": 5e-4, "unit8": 0.51 / 255, "bc3": 1.0}[encoding]
    error = np.abs(found - masks)
    assert error.max() <= worst
    # noise lies on no line of four colors: BC3 is then only nearer than the mean of all texels
    assert np.sqrt(np.mean(error**2)) <= masks.std() + 1.0 / 255
    limit = {"float32": 3.5e38, "float16": 65504.0, "unit8": 1.0, "bc3": 1.0}[encoding]
    masks[0, 0, 0] = huge
    if huge > limit:
        with pytest.raises(wrinkle_expressions.WrinkleError, match="masks"):
            wrinkle_storage.round_trip_masks(masks, encoding)
    else:
        stored = wrinkle_storage.round_trip_masks(masks, encoding)
        assert stored[0, 0, 0] == pytest.approx(huge, rel=1e-3)
    masks[0, 0, 0] = bad
    with pytest.raises(wrinkle_expressions.WrinkleError, match="masks"):
        wrinkle_storage.round_trip_masks(masks, encoding)


@CHEAP
@given(
    seed=SEED,
    texels=SIDES,
    pixels=SIDES,
    kind=st.sampled_from([np.float32, np.float64]),
    level=st.floats(-1e30, 1e30),
)
def test_widened_planes_read_back_their_values(seed, texels, pixels, kind, level):
    planes = np.random.default_rng(seed).standard_normal((2, *texels))
    *wide, first, part = wrinkles.to_kernel_planes(planes, pixels, kind)
    assert first.shape == part.shape == (pixels[0],)
    assert ((part >= 0.0) & (part < 1.0)).all()
    for plane, given_plane in zip(wide, planes, strict=True):
        assert plane.shape[1] == pixels[1]
        assert plane.dtype == kind
        after = np.minimum(first + 1, len(plane) - 1)
        read = plane[first] * (1.0 - part)[:, None] + plane[after] * part[:, None]
        assert read.shape == pixels
        assert read.min() >= given_plane.min() - 1e-5
        assert read.max() <= given_plane.max() + 1e-5
    even, *_ = wrinkles.to_kernel_planes(np.full((1, *texels), level), pixels, np.float64)
    np.testing.assert_allclose(even, level, rtol=1e-12)


@CHEAP
@given(
    seed=SEED,
    sides=SIDES,
    bad=NO_NUMBER,
    kind=st.sampled_from([np.uint16, np.float32]),
    level=st.sampled_from([None, 0.5]),
)
def test_collected_images_keep_samples_and_mask_invalid_ones(seed, sides, bad, kind, level):
    rng = np.random.default_rng(seed)
    keys = [(name, "parallel") for name in ("full", "x", "y", "z")]
    pictures = {key: (1000.0 * rng.uniform(size=sides)).astype(kind) for key in keys}
    variance = {key: rng.uniform(0.1, 1.0, sides) for key in keys}
    variance[keys[1]][0, 0] = bad
    variance[keys[2]][0, 0] = -1.0
    top = None if level is None else 500.0
    given = PatternSamples(pictures, variance, None, top)
    stack = gradient_channels.sort_by_polarization(given)["parallel"]
    samples = stack.samples(slice(None), np.float64)
    spread = stack.variances(slice(None), np.float64)
    assert (np.isfinite(spread) & (spread > 0.0)).all()
    assert np.isnan(samples[[1, 2], 0, 0]).all()
    for k, key in enumerate(keys):
        shown = np.isfinite(samples[k])
        np.testing.assert_array_equal(samples[k][shown], pictures[key][shown].astype(np.float64))
        if top is not None:
            assert not shown[pictures[key] >= top].any()
    for wrong in (0.0, -1.0, bad):
        with pytest.raises(gradient_patterns.GradientError, match="variance"):
            gradient_channels.sort_by_polarization(PatternSamples(pictures, wrong, None, None))
    misspelled = {("ful", "parallel"): pictures[keys[0]]}
    with pytest.raises(gradient_patterns.GradientError, match="ful"):
        gradient_channels.sort_by_polarization(PatternSamples(misspelled, None, None, None))


@CHEAP
@given(seed=SEED, unit=st.sampled_from([1e-200, 1e-20, 1.0, 1e20, 1e200]), bad=NO_NUMBER)
def test_kernel_direction_dependence_is_unit_invariant(seed, unit, bad):
    rng = np.random.default_rng(seed)
    table = microstructure.FOREHEAD
    stretch = np.linspace(*table.stretch_range, 12)
    angle = np.tile([0.0, 0.8, 1.6], 4)
    alpha, sigma = microstructure.kernel_parameters(stretch, table)
    noise = rng.standard_normal((2, 12))
    plain = kernel_table.estimate_direction_dependence(
        table, stretch, alpha + noise[0], sigma + noise[1], angle
    )
    for p in (plain.p_alpha, plain.p_sigma):
        assert 0.0 <= p <= 1.0
    # residuals alone count: numbers far larger than the table's are residuals
    if unit > 1.0:
        large = kernel_table.estimate_direction_dependence(
            table, stretch, unit * noise[0], unit * noise[1], angle
        )
        assert large.p_alpha == pytest.approx(plain.p_alpha, rel=1e-6)
        assert np.isfinite(large.alpha_offset).all()
    turned = kernel_table.estimate_direction_dependence(
        table,
        stretch,
        alpha + np.select([angle == 0.0, angle == 0.8], [0.0, 3.0], -3.0),
        sigma,
        angle,
    )
    assert turned.p_alpha < 1e-6
    exact = kernel_table.estimate_direction_dependence(table, stretch, alpha, sigma, angle)
    assert np.isfinite([exact.p_alpha, exact.p_sigma]).all()
    for k in range(4):
        told = [stretch.copy(), alpha.copy(), sigma.copy(), angle.copy()]
        told[k][3] = bad
        with pytest.raises(kernel_table.KernelTableFitError, match="finite"):
            kernel_table.estimate_direction_dependence(table, *told)


@FEW
@given(seed=SEED, size=st.integers(8, 20), scale=st.floats(1e-6, 1e6))
def test_stored_color_table_keeps_positive_colors(tmp_path_factory, seed, size, scale):
    rgb = scale * np.random.default_rng(seed).uniform(0.01, 1.0, (size, size, 3))
    path = tmp_path_factory.mktemp("table") / "t.csv"
    color_table_file.write_color_table(path, ColorTable("camera", "light", rgb))
    np.testing.assert_array_equal(color_table_file.read_color_table(path).rgb, rgb)


@CHEAP
@given(x=st.floats(-1e6, 1e6), names=st.sets(st.sampled_from(("nose", "chin", "ear")), min_size=2))
def test_selected_sites_are_those_of_the_table(x, names):
    found = perfusion_curves.select_sites(dict.fromkeys(names, (x, 1.0)))
    assert found == dict.fromkeys(names - {"ear"}, (x, 1.0))
