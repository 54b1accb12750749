"""Mitsuba: the only folder that imports it, and the plugins that render skin in capture rigs.

BSDF `skincoat`, emitter `ledarray`, sensor `rigcamera`, integrators `olat` and `tissue`::

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import rigsim.mitsuba            # registers them, also for variants that are set later
    scene = mi.load_file("scene.xml")

A script that imports this package before Mitsuba calls `register` itself.
"""

import sys

from rigsim.mitsuba.plugins import register

__all__ = ["register"]

if "mitsuba" in sys.modules:
    register(sys.modules["mitsuba"])
