"""Sphinx settings."""

project = "torch_dpc"
author = "The torch_dpc authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "amsmath"]
html_theme = "furo"
autodoc_member_order = "bysource"
autodoc_typehints = "none"


def setup(app):
    """Let |x| in a docstring be a norm, not a substitution."""

    def escape(app, what, name, obj, options, lines):
        lines[:] = [line.replace("|", r"\|") for line in lines]

    app.connect("autodoc-process-docstring", escape)
