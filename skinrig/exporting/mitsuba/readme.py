"""Write the README of an exported Mitsuba scene."""

from collections.abc import Sequence
from typing import Final

_HEAD: Final = """\
{title} as a scene of Mitsuba 3 (https://www.mitsuba-renderer.org)

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")  # {scalar}
    import rigsim.mitsuba          # {plugins}
    scene = mi.load_file("{scene}", light="{light}")
    image = mi.render(scene{options})
"""

_TAIL: Final = """
On a machine with one core, call drjit.set_thread_count(2) before a scene is loaded: Mitsuba 3.9
never finishes reading an EXR image with a single thread.
"""

DOME_README: Final = (
    _HEAD.replace("{title}", "A simulated light dome session")
    .replace("{scalar}", "or scalar_rgb, for scene-stock.xml")
    .replace("{plugins}", "for scene.xml only")
    .replace("{scene}", "scene.xml")
    .replace("{options}", ", sensor=0, spp=64")
    + """
scene.xml         needs the plugins skincoat, ledarray and rigcamera: import rigsim.mitsuba
scene-stock.xml   loads in a plain Mitsuba, whose materials and lights it uses
face.ply          mesh, mm, rig frame: +x right, +y up, +z towards the main camera
textures/         maps of the skin, linear EXR, raw values, row 0 is v = 1
lights/           one table per LED, and all.csv; lights-stock/ has them as spot lights
mitsuba.json      LEDs, cameras, units, provenance, what the scene lacks

Parameters of the scene: light (name of an LED, or all), samples per pixel, depth (2: direct light;
-1: all interreflections). Cameras, in the order of sensor=0, 1, ...: {views}.

Values of an image: camera RGB, fraction of full scale per second of on-time at level 1. Times the
camera's gain in mitsuba.json it is the signal of the session's sensor, before noise, vignetting and
color filter array.
"""
    + _TAIL
    + """
Differences of scene-stock.xml from scene.xml
- Vellus hair is missing: its scattering, up to 0.0015 of optical depth, brightens grazing angles.
- A coating (water, lotion, foundation, powder) is missing.
- The interior is Mitsuba's plastic: its diffuse reflectance is scaled such that both are equal
  within 0.1 % (stock_diffuse.exr = 2 x plastic's factor x r_d.exr; 2: a blend averages).
- Each LED is a point with its lobe cos^n as an image, not a disc: its shadows are sharp.
- Distortion by a camera's lens is missing (mitsuba.json has it; simulated lenses have none today).

Differences of both from the session
- Reflectance is camera RGB: with depth above 2, interreflections multiply channels, not spectra.
{left_out}"""
)

_POLARIZED: Final = (
    _HEAD.replace("{scalar}", "or scalar_rgb, for scene-stock-*.xml")
    .replace("{plugins}", "for scene-parallel.xml and scene-crossed.xml only")
    .replace("{scene}", "scene-crossed.xml")
    .replace("{options}", "")
    + """
scene-parallel.xml, scene-crossed.xml
                  image behind the parallel and the crossed analyzer, without noise; they need the
                  plugins skincoat, ledarray, rigcamera and olat of skinrig: import rigsim.mitsuba
scene-stock-parallel.xml, scene-stock-crossed.xml
                  the same for a plain Mitsuba, whose materials and lights they use
face.ply          surface of the skin, mm, rig frame: +x right, +y up, +z towards the camera
textures/         maps of the skin, linear EXR, raw values, row 0 is v = 1
lights/           one table per pattern of lights; lights-stock/ has them as spot lights
mitsuba.json      lights with polarizers, patterns, camera, analyzer, units, provenance

Parameters: light ({patterns}); scene-*.xml: subpixels, rays along each side of a pixel;
scene-stock-*.xml: samples per pixel, and depth (2: direct light; -1: all interreflections).

Values of an image: {unit}. It is the
signal of the session's sensor, before noise, vignetting and a color filter array.
"""
    + _TAIL
    + """
Differences of scene-stock-*.xml from scene-*.xml
- Light has no polarization. Each of two polarizers halves it: light from below the surface is a
  quarter, at both stops of the analyzer.
- Crossed: the analyzer removes what the surface reflects, so that the scene has no specular
  reflection at all. In scene-crossed.xml a small part passes: by leaks of the polarizers, and where
  a facet rotates the polarization, most at grazing angles.
- Parallel: the surface's reflection is half that of unpolarized light. That of polarized light
  differs, most at grazing angles.
- The boundary transmits light of both polarizations alike.
- The interior is Mitsuba's plastic, whose diffuse reflectance is scaled as in a dome's scene.
- Each light is a point, not a disc: its shadows are sharp.

Differences of both from the session
"""
)

FLASH_README: Final = (
    _POLARIZED.replace("{title}", "A simulated session of the flash rig")
    .replace("{patterns}", "name of a flash, or all")
    .replace("{unit}", "camera RGB, fraction of full scale at power 1")
    + """\
- The scene is the session's first state, without exposures under narrow-band LEDs.
- Shadows are those of each camera ray; the session's diffuse light has those of the face's texels.
{left_out}"""
)

GRADIENT_README: Final = (
    _POLARIZED.replace("{title}", "A simulated session of the gradient sphere")
    .replace("{patterns}", "a pattern: full, x, y, z, -x, -y, -z")
    .replace("{unit}", "fraction of full scale per second at level 1")
    + """\
- The scene is the first relaxed state, without drift, up to 512 pixels across around the center.
- LEDs below the plane of the skin are missing: the tissue around the patch hides them.
- Diffuse light leaves where it entered, also in grooves.
{left_out}"""
)


def format_readme(
    text: str, views: Sequence[str], light: str, left_out: Sequence[tuple[str, str]]
) -> str:
    """Return the text of a README.

    Parameters
    ----------
    text
        `DOME_README`, `FLASH_README` or `GRADIENT_README`.
    views
        Names of the cameras, in the order of the scene's sensors.
    light
        Name of a pattern of lights, for the example.
    left_out
        Effects of the session that the scene lacks, with reasons.
    """
    lines = "".join(f"- Missing: {name} ({why}).\n" for name, why in left_out)
    return text.format(views=", ".join(views), light=light, left_out=lines)
