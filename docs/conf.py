"""How the documentation is built: ``make docs``. What is built works offline: nothing is fetched from elsewhere."""

import re
import sys
from pathlib import Path
from typing import Any, NewType

import numpy.typing
from docutils import nodes

# By its name, not as the union of ten types that it is; set before anything imports it.
numpy.typing.ArrayLike = NewType("ArrayLike", object)

import filtergym  # noqa: E402

project = "filtergym"
author = "The filtergym developers"
copyright = "The filtergym developers"
version = release = filtergym.__version__

# Tables and figures are rendered from records and code while the pages are built.
sys.path.insert(0, str(Path(__file__).parent / "make"))

extensions = [
    *("myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_design"),
    "record_directives",
]
# Examples and recipes are shown inside pages; the page of the package index stands alone.
exclude_patterns = ["examples", "recipes", "package_index.md"]

# Links to headings are written as on a repository's page, so that both find them; a broken one ends the build.
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_inline", "colon_fence"]

# `python docs/make notebooks` executes them, and commits what they print: a check of the pages must not take minutes.
nb_execution_mode = "off"

highlight_language = "none"  # of what names no language: output, formulas

# Types stand in the annotations only, and each argument shows its own.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = "filtergym"
html_static_path = ["_static"]
html_css_files = ["filtergym.css"]
# Set before the theme reads it, which reports an error where nothing is set; `default_mode` would hide all colours from
# browsers without scripts.
html_js_files = [(None, {"body": "document.documentElement.dataset.mode ||= 'auto'"})]
html_show_sourcelink = False
html_copy_source = False
html_use_index = html_domain_indices = False  # the search finds names
html_sidebars = {"log_file": []}  # no page stands below it
html_theme_options = {
    "logo": {"text": "filtergym"},
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navbar_end": ["theme-switcher"],
    "show_nav_level": 1,
    "show_toc_level": 2,
    "navigation_depth": 3,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}


COLON = "\ue000"
"""Stands for a colon where Google's style would take what is before it for a type."""


def _hide_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Keep the sentence below a field whole: types stand in the annotations."""
    if what in ("attribute", "property", "data"):
        lines[:] = [line.replace(":", COLON) for line in lines]


def _show_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = [line.replace(COLON, ":") for line in lines]


def _formulas_as_they_stand(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Show what a docstring sets off by indentation, formulas and code, as it stands; other lines flow."""
    before, inside, shown = "", False, []
    for i, line in enumerate(lines):
        inside = inside and (not line or line.startswith("    "))
        fresh = line.startswith("    ") and i > 0 and not lines[i - 1].strip() and not inside
        if fresh and before and not before.startswith((" ", ".. ", ":", "* ", "- ")) and before[-2:] != "::":
            shown += ["::", ""]
            inside = True
        shown.append(line)
        before = line.rstrip() or before
    lines[:] = shown


def _without_counted_fields(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Drop Python's own text on a named tuple's field without documentation."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()


def _intervals_in_one_piece(app: Any, document: nodes.document) -> None:
    """Do not break ``[-48.1, -43.0]`` in a cell of a table."""
    for entry in document.findall(nodes.entry):
        for text in list(entry.findall(nodes.Text)):
            kept = re.sub(r"\[([-+\d.]+), ([-+\d.]+\])", "[\\1,\N{NO-BREAK SPACE}\\2", text)
            if kept != text:
                text.parent.replace(text, nodes.Text(kept))


def setup(app: Any) -> None:
    """Register what is done to docstrings before and after Google's style is read, and to pages."""
    app.connect("autodoc-process-docstring", _hide_colons, priority=400)
    for change in (_show_colons, _formulas_as_they_stand, _without_counted_fields):
        app.connect("autodoc-process-docstring", change, priority=600)
    app.connect("doctree-read", _intervals_in_one_piece)
