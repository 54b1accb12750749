"""Build elements of Mitsuba's XML scene files, as text: no renderer is imported."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

FORMAT_VERSION: Final = "3.0.0"
"""Version of Mitsuba's scene format."""

Element = ElementTree.Element


def build_plugin(tag: str, type_name: str, *children: Element, **attributes: str) -> Element:
    """Return the element of a plugin with its properties.

    Parameters
    ----------
    tag
        Kind of plugin, such as ``bsdf``.
    type_name
        Name of the plugin.
    children
        Its properties and nested plugins.
    attributes
        ``id`` or ``name``.

    Examples
    --------
    >>> format_element(build_plugin("rfilter", "box"))
    '<rfilter type="box" />'
    """
    element = Element(tag, {"type": type_name, **attributes})
    element.extend(children)
    return element


def build_property(name: str, value: Any) -> Element:
    """Return a property of a plugin; its tag follows from the type of its value.

    Parameters
    ----------
    name
        Name of the property.
    value
        bool, int, float, str, or three numbers of an RGB value.

    Examples
    --------
    >>> format_element(build_property("raw", True)), format_element(build_property("alpha", 0.5))
    ('<boolean name="raw" value="true" />', '<float name="alpha" value="0.5" />')
    """
    if isinstance(value, bool):
        return Element("boolean", {"name": name, "value": str(value).lower()})
    if isinstance(value, str):
        return Element("string", {"name": name, "value": value})
    if isinstance(value, int):
        return Element("integer", {"name": name, "value": str(value)})
    if isinstance(value, float):
        return Element("float", {"name": name, "value": _format_number(value)})
    return Element("rgb", {"name": name, "value": _format_row(value)})


def build_texture(name: str, file: str) -> Element:
    """Return a texture of raw values, interpolated bilinearly, clamped at its border.

    Parameters
    ----------
    name
        Name of the property of the plugin that reads it.
    file
        File of the image, below the scene's folder.
    """
    return build_plugin(
        "texture",
        "bitmap",
        build_property("filename", file),
        build_property("raw", True),
        build_property("filter_type", "bilinear"),
        build_property("wrap_mode", "clamp"),
        name=name,
    )


def build_pose(position: Iterable[float], target: Iterable[float], up: Iterable[float]) -> Element:
    """Return the ``to_world`` of a camera or light that points at a target, mm."""
    transform = Element("transform", {"name": "to_world"})
    rows = {"origin": position, "target": target, "up": up}
    transform.append(Element("lookat", {key: _format_row(row) for key, row in rows.items()}))
    return transform


def write_scene(path: Path, children: Iterable[Element], comment: str = "") -> None:
    """Write a scene file; equal elements give equal bytes.

    Parameters
    ----------
    path
        File.
    children
        Elements of the scene.
    comment
        Comment on top.
    """
    scene = Element("scene", {"version": FORMAT_VERSION})
    if comment:
        scene.append(ElementTree.Comment(f" {comment} "))
    scene.extend(children)
    ElementTree.indent(scene)
    path.write_text(format_element(scene) + "\n", encoding="utf-8")


def format_element(element: Element) -> str:
    """Return an element as text."""
    return ElementTree.tostring(element, encoding="unicode")


def _format_row(values: Iterable[float]) -> str:
    return ", ".join(_format_number(value) for value in values)


def _format_number(value: float) -> str:
    return format(float(value), ".9g")
