"""Render templates of HTML pages, and name what their content security policies allow."""

import base64
import functools
import hashlib

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


def hash_inline(text: str) -> str:
    """Return the source by which a content security policy allows an inline style or script.

    Examples
    --------
    >>> hash_inline("body{margin:0}")
    'sha256-IAdwN3biDCQ3brrgp1m8kBEsPQYyqfREKOEfeoREopc='
    """
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode()


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
