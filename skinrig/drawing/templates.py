"""Render templates of HTML pages."""

import functools

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(name: str, **data: object) -> str:
    """Fill in a template of this package; values that are not ``Markup`` are escaped.

    Parameters
    ----------
    name
        Path inside the package, such as "viewer/page.html".
    data
        Values of the names in the template; a missing name raises.
    """
    return _environment().get_template(name).render(data)


@functools.cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("skinrig", ""),
        autoescape=True,
        undefined=StrictUndefined,
        extensions=["jinja2.ext.do"],
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
