"""Templates of HTML pages, which hold all markup that is not a drawing."""

import functools

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(name: str, **data: object) -> str:
    """Fill a template of this package in; what is no ``Markup`` is escaped.

    Parameters
    ----------
    name
        Path inside the package, such as "viewer/page.html".
    data
        What the template names; a name that is missing is an error.
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
