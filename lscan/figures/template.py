"""Jinja2 templates of pages, which lie beside the modules that fill them."""

from collections.abc import Callable

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


def page_template(package: str, name: str, **filters: Callable[..., object]) -> Template:
    """The template of a page.

    Parameters
    ----------
    package, name : str
        The package that holds the file, and the file's name.
    **filters : callable
        Functions that the template uses, by their names there.

    Returns
    -------
    jinja2.Template
        What is filled in is escaped; a value that the template needs and does not get is an error.
    """
    environment = Environment(
        loader=PackageLoader(package, ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    return environment.get_template(name)
