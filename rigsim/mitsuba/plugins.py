"""Register the plugins for Mitsuba's variants."""

from collections.abc import Callable
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
    """Register each plugin, or the reason why it does not work in the active variant."""
    variant = mi.variant()
    if variant in _REGISTERED_VARIANTS:
        return
    _REGISTERED_VARIANTS.add(variant)
    is_vectorized = not variant.startswith("scalar")
    is_rgb = is_vectorized and variant.endswith("_rgb")
    vectorized = "a vectorized one, such as llvm_ad_rgb"
    for add, name, define, works, expected in (
        (mi.register_bsdf, "skincoat", define_skin_coat, True, ""),
        (mi.register_emitter, "ledarray", define_led_array, is_vectorized, vectorized),
        (mi.register_sensor, "rigcamera", define_rig_camera, is_vectorized, vectorized),
        (mi.register_integrator, "olat", define_olat, is_rgb, "llvm_ad_rgb"),
        (mi.register_integrator, "ledmoments", define_led_moments, is_rgb, "llvm_ad_rgb"),
    ):
        add(name, define(mi) if works else _refuse_variant(name, variant, expected))
    if is_vectorized and not (mi.is_polarized or mi.is_spectral):
        define_tissue(mi)
    else:
        why = _refuse_variant("tissue", variant, "llvm_ad_rgb or llvm_ad_mono")
        mi.register_integrator("tissue", why)


def _refuse_variant(name: str, variant: str, expected: str) -> Callable[[Any], Any]:
    """Return what raises the error of a plugin that does not work in a variant."""

    def refuse(properties: Any) -> Any:
        raise ValueError(
            f"{name}: got the variant {variant}, expected {expected}; call mi.set_variant first"
        )

    return refuse
