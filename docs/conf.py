"""Sphinx configuration; ``make docs`` builds into build/docs, with warnings as errors."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import gpuvision

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))

project = "gpuvision"
author = "gpuvision developers"
copyright = author
release = version = gpuvision.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "numpydoc",
    "myst_parser",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "api_pages",
    "cli_pages",
    "results_pages",
]
exclude_patterns = ["_ext", "_static", "gallery/**.ipynb", "gallery/**.py", "gallery/**.json"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

# `name` in a docstring links to that name where it has a page, and is code otherwise.
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
autodoc_type_aliases = {"npt.ArrayLike": "ArrayLike", "DTypeLike": "DTypeLike"}
# References to gpuvision must exist, but a name in single backticks may be plain code. Other libraries are not linked.
nitpicky = True
nitpick_ignore_regex = [
    ("py:obj", r".*"),
    ("py:.*", r"(?!gpuvision\.).*"),
    ("py:class", r"gpuvision\.(.*\.)?(_\w+|[RS]|AnyTrial|schema\.Section)"),  # private bases, type variables
]
suppress_warnings = ["ref.citation"]  # a docstring's section References may list works that its text does not cite
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3

# Examples run with the headless backend, in the order of their numbers; an example that fails fails the build.
os.environ["MPLBACKEND"] = "Agg"
sphinx_gallery_conf = {
    "examples_dirs": [str(HERE.parent / "examples")],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "gallery_hooks.place",
    "reset_modules": ("matplotlib", "gallery_hooks.define_file"),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "show_memory": False,
    "remove_config_comments": True,
    "min_reported_time": 1e9,
}

# Pages without pages below them have no navigation on the left.
html_sidebars = {name: [] for name in ("install", "glossary", "changelog", "contributing")}
html_theme = "pydata_sphinx_theme"
html_title = f"gpuvision {release}"
html_static_path = ["_static"]
html_css_files = ["gpuvision.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "show_prev_next": True,
    "header_links_before_dropdown": 8,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "navbar_align": "left",
    "footer_start": ["copyright"],
    "footer_end": [],
}
