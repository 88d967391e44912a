"""How the documentation is built: `sphinx-build -W -b html notebooks build/docs`."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import vcal  # noqa: E402

project = "vcal"
author = "The vcal developers"
copyright = "The vcal developers"
version = release = vcal.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "_site.api",
    "_site.bounds",
    "_site.commands",
    "_site.docstrings",
    "_site.effects",
    "_site.mathml",
    "_site.notebooks",
    "_site.offline",
    "_site.published",
    "_site.record_keys",
    "_site.study_keys",
]
exclude_patterns = ["_site", "**/.ipynb_checkpoints", "README.md"]

myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
autodoc_default_options = {"member-order": "bysource"}
autodoc_inherit_docstrings = False  # what overrides a method is documented there
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
smartquotes = False
nb_execution_mode = "off"  # _site.notebooks puts the outputs in
html_math_renderer = "mathml"
html_theme = "furo"
html_static_path = ["_site/static"]
html_css_files = ["style.css"]
html_copy_source = False
html_title = f"vcal {version}"
