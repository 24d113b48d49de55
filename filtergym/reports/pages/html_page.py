"""Common parts of self-contained pages: packed data, Plotly, and scripts that run by their hashes only.

All data are text: the template escapes them, the figures' data are packed, and the page's content
security policy runs two scripts only, the page's own and Plotly's.
"""

import base64
import gzip
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import jinja2
import markupsafe
from plotly.offline import get_plotlyjs

HTML = Path(__file__).parent / "html"


def render_page(template: str, script: str, **values: Any) -> str:
    """Return an HTML page from a template and its ``values``, with its scripts and Plotly inside."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HTML), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["marked"] = mark_code
    parts = ((HTML / name).read_text(encoding="utf-8") for name in ("page.js", script))
    own, plotly = f'"use strict";\n(() => {{\n{"".join(parts)}}})();\n', get_plotlyjs()
    return environment.get_template(template).render(
        style=markupsafe.Markup((HTML / "report.css").read_text(encoding="utf-8")),
        script=markupsafe.Markup(own),
        plotly=pack_text(plotly),
        hashes=[_hash(plotly), _hash(own)],
        **values,
    )


def _hash(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def pack(values: Any) -> str:
    """Return values as JSON, compressed and in base64, for a page's script."""
    return pack_text(json.dumps(values, allow_nan=False, separators=(",", ":")))


def pack_text(text: str) -> str:
    """Return text, compressed and in base64, for a page's script."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def mark_code(text: str) -> markupsafe.Markup:
    """Return text escaped for HTML, with the words between backticks as ``<code>``."""
    parts = re.split(r"`([^`]*)`", text)
    pieces = [
        markupsafe.Markup("<code>{}</code>").format(part) if i % 2 else markupsafe.escape(part)
        for i, part in enumerate(parts)
    ]
    return markupsafe.Markup("").join(pieces)
