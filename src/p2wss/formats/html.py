"""The template engine of HTML pages: text from the data is escaped, and a value that a page lacks is an error."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2


def environment(*packages: str) -> jinja2.Environment:
    """The environment of the templates in the folders ``templates`` of packages, such as ``p2wss.eval``.

    A template that uses an undefined value raises ``jinja2.UndefinedError``. Lines that hold only a statement leave
    no blank lines in the page.
    """
    import jinja2  # only once a page is written

    return jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package) for package in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
