"""Mitsuba: the only folder that imports it, and the plugins that render skin in capture rigs.

BSDF `skincoat`, emitter `ledarray`, sensor `rigcamera`, integrators `olat` and `tissue`::

    import mitsuba as mi
    import rigsim.mitsuba            # registers them, for variants that are set before and later
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")

The order of these two imports is free.
"""

from rigsim.mitsuba.import_hook import register_on_import
from rigsim.mitsuba.plugins import register

__all__ = ["register"]

register_on_import()
