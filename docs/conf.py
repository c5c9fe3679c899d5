"""How Sphinx builds these pages; `make docs` runs it."""

import sys
from pathlib import Path

import torchface

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "extensions"))

project = "torchface"
author = "the torchface authors"
copyright = "the torchface authors, MIT licence"
release = version = torchface.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml"]
exclude_patterns = ["README.md", "extensions", "images"]

myst_enable_extensions = ["amsmath", "attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Tutorials run when they, or what they are run with, change; what they print and draw is kept beside the pages.
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE.parent / "out" / "docs_cache")
nb_execution_timeout = 300
nb_execution_in_temp = True  # notebooks write files
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
autodoc_inherit_docstrings = False  # torch says of every module the same
autodoc_preserve_defaults = False  # numbers, where the code names them
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_maximum_signature_line_length = 88
add_module_names = True  # says where a name is imported from

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"torchface {release}"
html_static_path = ["static"]
html_css_files = ["torchface.css"]
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f5f99", "color-brand-content": "#1f5f99"},
    "dark_css_variables": {"color-brand-primary": "#7fb7e6", "color-brand-content": "#7fb7e6"},
}
