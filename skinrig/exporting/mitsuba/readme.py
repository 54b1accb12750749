"""Write the README of an exported Mitsuba scene."""

from collections.abc import Sequence
from typing import Final

_TEXT: Final = """\
A simulated light dome session as a scene of Mitsuba 3 (https://www.mitsuba-renderer.org)

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")  # or scalar_rgb
    import rigsim.mitsuba          # for scene.xml only
    scene = mi.load_file("scene.xml", light="{light}")
    image = mi.render(scene, sensor=0, spp=64)

scene.xml         needs the plugins skincoat and ledarray of skinrig: import rigsim.mitsuba
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

On a machine with one core, call drjit.set_thread_count(2) before a scene is loaded: Mitsuba 3.9
never finishes reading an EXR image with a single thread.

Differences of scene-stock.xml from scene.xml
- Vellus hair is missing: its scattering, up to 0.0015 of optical depth, brightens grazing angles.
- A coating (water, lotion, foundation, powder) is missing.
- The interior is Mitsuba's plastic: its diffuse reflectance is scaled such that both are equal
  within 0.1 % (stock_diffuse.exr = 2 x plastic's factor x r_d.exr; 2: a blend averages).
- Each LED is a point with its lobe cos^n as an image, not a disc: its shadows are sharp.

Differences of both from the session
- Reflectance is camera RGB: with depth above 2, interreflections multiply channels, not spectra.
{left_out}"""


def format_readme(views: Sequence[str], light: str, left_out: Sequence[tuple[str, str]]) -> str:
    """Return the text of the README.

    Parameters
    ----------
    views
        Names of the cameras, in the order of the scene's sensors.
    light
        Name of an LED, for the example.
    left_out
        Effects of the session that the scene lacks, with reasons.
    """
    lines = "".join(f"- Missing: {name} ({why}).\n" for name, why in left_out)
    return _TEXT.format(views=", ".join(views), light=light, left_out=lines)
