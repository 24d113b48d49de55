"""How the documentation is built: ``make docs``. What is built works offline: nothing is fetched from elsewhere."""

from typing import Any

import filtergym

project = "filtergym"
author = "The filtergym developers"
copyright = "The filtergym developers"
version = release = filtergym.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_design"]
# Examples and recipes are shown inside pages; the page of the package index stands alone.
exclude_patterns = ["examples", "recipes", "package_index.md"]

# Links to headings are written as on a repository's page, so that both find them; a broken one ends the build.
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_inline", "colon_fence"]

# Types stand in the annotations only, and each argument shows its own.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = "filtergym"
html_static_path = ["_static"]
html_css_files = ["filtergym.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "filtergym"},
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "show_nav_level": 1,
    "show_toc_level": 2,
    "navigation_depth": 3,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}


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
    """Drop what Python itself says of a named tuple's field without documentation."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()


def setup(app: Any) -> None:
    """Register what is done to docstrings, after the sections of Google's style have been read."""
    app.connect("autodoc-process-docstring", _formulas_as_they_stand, priority=600)
    app.connect("autodoc-process-docstring", _without_counted_fields, priority=600)
