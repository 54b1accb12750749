"""Functions that scripts outside the repository call keep their names and leading parameters."""

import importlib
import inspect

import pytest

PUBLIC = """
capture.calibration.geometry.calibrate_intrinsics images * pattern square_mm
capture.calibration.color.find_chart image
capture.calibration.color.fit_matrix camera_rgb reference * method
capture.hdr.merge frames exposures_s * gain read_noise black white
capture.raw.read path
capture.raw.write_dng path cfa
reconstruction.polarization.separate parallel crossed * \
extinction normals light_dir view_dir variance
reconstruction.chromophores.invert rgb table * shading variance
reconstruction.photometric_stereo.estimate_normals intensity_nhw light_directions_n3 * \
light_positions_mm points_mm light_intensity variance valid robust
reconstruction.gradient_normals.from_patterns patterns * component view variance
reconstruction.normal_integration.integrate normals * pixel valid
reconstruction.normal_histogram.histogram height * pixel bins limit
reconstruction.kernel_fit.fit_kernel neutral_height_um target_histogram * stretch axis pixel_um bins
reconstruction.subsurface.invert radius_mm reflectance_per_mm2 * eta variance method
reconstruction.subsurface.fit_dipole radius_mm reflectance_per_mm2 * eta variance
reconstruction.diffuse_albedo.estimate brdf_samples light_dirs view_dirs normals * \
eta variance discard
reconstruction.brdf_basis.fit_weights samples basis * compress
reconstruction.brdf_basis.reduce weights rank
model.tissue_optics.two_layer_reflectance wavelength_nm c_m c_hd * beta_m c_he tier
model.tissue_optics.layer_stack_reflectance sigma_a_per_mm sigma_s_prime_per_mm \
thickness_mm * eta tier
model.dipole.reflectance radius_mm sigma_a_per_mm sigma_s_prime_per_mm eta
model.dipole.total_reflectance albedo_prime eta
model.dipole.invert_total_reflectance r_d eta
model.color_table.build camera illuminant * size
model.color_table.ColorTable.lookup self c_m c_hd
model.facial_color.local_statistics h radius_px
model.facial_color.HemoglobinRig.from_maps neutral states * radius_px
model.facial_color.HemoglobinRig.blend self weights
model.wrinkles.encode normals
model.wrinkles.decode derivatives
model.wrinkles.combine base wrinkle masks weights
model.microstructure.kernel_parameters stretch table
model.microstructure.convolve height axis_s axis_t alpha_s sigma_s alpha_t sigma_t
model.microstructure.strain rest_vertices deformed_vertices faces uv
model.merl.read path
model.merl.MerlTable.lookup self theta_h theta_d phi_d
model.merl.write path table
model.texture_statistics.describe image
model.texture_statistics.match image target * iterations
model.traits.TraitSpace.fit samples labels
model.traits.TraitSpace.edit self sample amounts
"""


def found_at(name):
    """Return the object of a dotted name: modules as far as they go, attributes from there."""
    parts = name.split(".")
    for end in range(len(parts) - 1, 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            thing = getattr(thing, part)
        return thing
    raise AssertionError(name)


@pytest.mark.parametrize("line", PUBLIC.strip().splitlines(), ids=lambda line: line.split()[0])
def test_public_function_is_found_with_unchanged_parameters(line):
    name, *wanted = line.split()
    parameters = inspect.signature(found_at(name)).parameters.values()
    free = [p.name for p in parameters if p.kind is not inspect.Parameter.KEYWORD_ONLY]
    by_name = {p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}
    cut = wanted.index("*") if "*" in wanted else len(wanted)
    assert free[: len(wanted[:cut])] == wanted[:cut]
    assert set(wanted[cut + 1 :]) <= by_name
