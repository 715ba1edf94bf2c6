"""Settings of Sphinx for this documentation: ``make docs``."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import tpm_gym

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent / "benchmarks")]  # website/ and studies/

project = "tpm_gym"
author = "The tpm_gym developers"
release = version = tpm_gym.__version__
language = "en"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "website",
]
exclude_patterns = ["figures", "gradients", "records", "results", "website"]

# -- Markdown --------------------------------------------------------------------------------------

myst_heading_anchors = 4
myst_enable_extensions = ["attrs_block", "colon_fence"]
myst_url_schemes = ["http", "https", "mailto", "source"]
suppress_warnings = ["myst.header"]  # a page of docstrings begins where its room's heading ends

_VIEWER = "_static/viewer/index.html"  # an export of `tpm-gym view`
_FRAME = f'<iframe class="viewer" src="{_VIEWER}" title="Robot, to be turned"></iframe>'


def setup(app: Any) -> None:
    """Show the viewer in the place of the front page's picture, if there is an export of it."""
    app.connect("source-read", show_viewer)


def show_viewer(app: Any, page: str, text: list[str]) -> None:
    """Replace the picture in the source of the front page."""
    del app
    if page == "index" and (DOCS / _VIEWER).exists():
        text[0], count = re.subn(r"!\[.*\]\(images/pick_and_place\.gif\)", _FRAME, text[0])
        assert count == 1, "index.md has no such picture"


# -- docstrings ------------------------------------------------------------------------------------

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_type_aliases = {
    name: name
    for name in (
        "Action",
        "ArrayLike",
        "BoolArray",
        "FloatArray",
        "IntArray",
        "Observation",
        "Vector",
    )
}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
nitpicky = True
# Other packages' names are not in this documentation; the names of this package are checked.
nitpick_ignore_regex = [("py:.*", r"(?!tpm_gym).*")]

# -- pages -----------------------------------------------------------------------------------------

html_theme = "furo"
html_title = f"tpm_gym {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_copyright = False
html_copy_source = False
html_show_sourcelink = False
