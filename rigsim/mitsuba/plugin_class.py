"""Make a plugin's class from its methods, for any of Mitsuba's variants."""

from typing import Any


def define_plugin(mi: Any, base: Any, methods: type) -> Any:
    """Return a class of Mitsuba's active variant with the methods of another class.

    Each variant has its own base classes, which exist after its choice only, and none of them can
    be one of several bases.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    base
        Its base class, such as ``mi.BSDF``.
    methods
        A class; its methods find ``mitsuba`` and ``drjit`` as ``self.mi`` and ``self.dr``.
    """
    import drjit as dr

    members = {k: v for k, v in vars(methods).items() if k not in ("__dict__", "__weakref__")}
    return type(methods.__name__.lstrip("_"), (base,), {**members, "mi": mi, "dr": dr})
