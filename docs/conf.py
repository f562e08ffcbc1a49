"""The documentation site: `make docs` builds it, offline, with warnings as errors.

The sources are the repository's own folders (docs, notebooks, reports of studies), so that a
relative link means the same on the site as in the tree.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

import casadi_ik  # noqa: E402

PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
URLS = PROJECT.get("urls", {})

project = "casadi_ik"
version = release = casadi_ik.__version__
author = "The casadi_ik developers"
copyright = author  # noqa: A001  (Sphinx's own name)
root_doc = "docs/index"
language = "en"
smartquotes = False

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_nb",
    "sphinx_copybutton",
    "building.llms",
    "building.mathml",
    "building.pages",
    "building.sources",
]
include_patterns = [
    "docs/**.md",
    "notebooks/*.ipynb",
    "studies/results/**.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "GOVERNANCE.md",
    "SECURITY.md",
    "CHANGELOG.md",
]
exclude_patterns = [".*", "**/.*", "out", "build", "dist", "casadi_ik", "models", "tests"]

# Notebooks are executed by the tests; here they are shown as they were stored.
nb_execution_mode = "off"
nb_merge_streams = True
# Tables and formulas in outputs of cells are converted like those of the text.
nb_render_markdown_format = "myst"
myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

# `name` in a docstring is a link where it is a public name, and code where not.
default_role = "py:obj"
nitpicky = True
nitpick_ignore_regex = [("py:obj", r".*"), ("py:class", r".*"), ("py:data", r".*")]
autodoc_member_order = "bysource"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
add_module_names = False

html_title = f"casadi_ik {version}"
html_baseurl = URLS.get("Documentation", "")
html_favicon = "static/favicon.svg"
html_context = {"repository": URLS.get("Repository", ""), "version": version}
html_sidebars = {
    "**": [
        "sidebar/brand.html",
        "sidebar/search.html",
        "sidebar/scroll-start.html",
        "sidebar/navigation.html",
        "about.html",
        "sidebar/scroll-end.html",
    ]
}
templates_path = ["templates"]
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["extra"]
html_copy_source = False
html_show_sphinx = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#0b5c8a",
        "color-brand-content": "#0b6aa2",
    },
    "dark_css_variables": {
        "color-brand-primary": "#6cc3f5",
        "color-brand-content": "#6cc3f5",
    },
}
html_math_renderer = "mathml"
