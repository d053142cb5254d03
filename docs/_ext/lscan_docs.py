"""Sphinx directives that write what the code knows: keys, commands, codes, plug-ins, names."""

import importlib
import inspect
from pathlib import Path
from typing import Any

import commandline
import docstrings
import drawing
import gallery
import lists
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from lscan.config.userfiles import Section, as_markdown, find_file

KINDS = "board", "rig", "scene", "shapes", "views", "study", "dataset", "suite", "catalogue"


def sections_on(argument: str) -> list[Section]:
    """The sections on a page: ``KIND``, but for those on the page of a kind before it, or
    ``KIND TABLE``, those of one table."""
    kind, _, table = argument.partition(" ")
    before = [one for other in KINDS[: KINDS.index(kind)] for one in find_file(other).sections]
    told = {(one.model, one.variant) for one in before}
    if table:
        return [one for one in find_file(kind).sections if one.name == table]
    own = [one for one in find_file(kind).sections if (one.model, one.variant) not in told]
    return [one for one in own if not one.name.endswith(".options")]


class Generated(SphinxDirective):
    """Base of directives whose text is made from their one argument."""

    required_arguments = 1
    final_argument_whitespace = True

    @property
    def pictures(self) -> Path:
        """The folder that keeps the pictures of this build."""
        return Path(self.env.doctreedir) / "pictures"

    def text(self, argument: str) -> str:
        """The MyST text that takes the directive's place."""
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        """The nodes of the text."""
        self.env.note_reread()
        text = self.text(self.arguments[0])
        return list(self.parse_text_to_nodes(text, allow_section_headings=True))


class FileKeys(Generated):
    """``{file-keys} rig``: every section of a file with its keys."""

    def text(self, argument: str) -> str:
        return "\n".join(map(as_markdown, sections_on(argument)))


class Commands(Generated):
    """``{commands} lscan``: every command with its arguments and options."""

    def text(self, argument: str) -> str:
        return commandline.as_markdown(argument)


class Listed(Generated):
    """``{listed} status``: a table of what the code registers or enumerates."""

    def text(self, argument: str) -> str:
        return lists.TABLES[argument]()


class PublicNames(Generated):
    """``{public-names} lscan``: autodoc of each name of the module's ``__all__``."""

    def text(self, argument: str) -> str:
        module = importlib.import_module(argument)
        lines = ["```{eval-rst}"]
        for name in getattr(module, "__all__", []):
            value = getattr(module, name)
            if inspect.isclass(value):
                lines += [f".. autoclass:: {argument}.{name}", "   :members:", ""]
            elif inspect.isroutine(value):
                lines += [f".. autofunction:: {argument}.{name}", ""]
            else:
                lines += [f".. autodata:: {argument}.{name}", ""]
        return "\n".join([*lines, "```"])


class ImportGraph(Generated):
    """``{import-graph} lscan``: the rooms of a package and what they import, drawn."""

    def text(self, argument: str) -> str:
        path = drawing.write(argument, self.env.srcdir, self.pictures)
        return f"![Rooms of {argument}: an arrow is an import]({path})"


class Gallery(Generated):
    """``{gallery} scenes``: a picture of every scene."""

    def text(self, argument: str) -> str:
        return gallery.as_markdown(argument, self.env.srcdir, self.pictures)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("file-keys", FileKeys)
    app.add_directive("commands", Commands)
    app.add_directive("listed", Listed)
    app.add_directive("public-names", PublicNames)
    app.add_directive("import-graph", ImportGraph)
    app.add_directive("gallery", Gallery)
    app.connect("autodoc-process-docstring", docstrings.types_apart, priority=400)  # first
    app.connect("autodoc-process-docstring", docstrings.fields_as_list)
    app.connect("missing-reference", docstrings.internal_name)
    return {"parallel_read_safe": False}
