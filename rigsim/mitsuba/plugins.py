"""Register the plugins for Mitsuba's variants."""

from typing import Any, Final

from rigsim.mitsuba.led_array import define_led_array
from rigsim.mitsuba.led_moments import define_led_moments
from rigsim.mitsuba.olat import define_olat
from rigsim.mitsuba.rig_camera import define_rig_camera
from rigsim.mitsuba.skin_coat import define_skin_coat
from rigsim.mitsuba.voxel_skin.integrator import define_tissue

_REGISTERED_VARIANTS: Final[set[str]] = set()


def register(mi: Any) -> None:
    """Register the plugins for the active variant, and for each that is set later.

    Parameters
    ----------
    mi
        The module ``mitsuba``.
    """
    if not _REGISTERED_VARIANTS:
        _REGISTERED_VARIANTS.add("")
        mi.detail.add_variant_callback(lambda old, new: _register_variant(mi))
    if mi.variant() is not None:
        _register_variant(mi)


def _register_variant(mi: Any) -> None:
    if mi.variant() in _REGISTERED_VARIANTS:
        return
    _REGISTERED_VARIANTS.add(mi.variant())
    if not (mi.is_polarized or mi.is_spectral or mi.variant().startswith("scalar")):
        define_tissue(mi)
    for add, name, plugin in (
        (mi.register_bsdf, "skincoat", define_skin_coat(mi)),
        (mi.register_emitter, "ledarray", define_led_array(mi)),
        (mi.register_sensor, "rigcamera", define_rig_camera(mi)),
        (mi.register_integrator, "olat", define_olat(mi)),
        (mi.register_integrator, "ledmoments", define_led_moments(mi)),
    ):
        add(name, plugin)
