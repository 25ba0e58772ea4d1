"""Configuration of the documentation: `sphinx-build -W --keep-going docs build/docs` (extra `docs`).

The build runs the notebooks that changed, about two minutes on two cores; JSECON_NOTEBOOKS=off leaves them out.
Built pages ask no other host for anything: formulas become MathML at the build, and fonts, scripts and pictures lie
beside the pages.
"""

import contextlib
import io
import os
import re
import textwrap
from typing import Any

import latex2mathml.converter
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import jsecon
from jsecon.app import cli, verbs

project = "jsecon"
author = "the jsecon authors"
copyright = "the jsecon authors, Apache-2.0"
version = release = jsecon.__version__

# The notebooks compile much and compute little: their kernels compile fast, as the tests do.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
default_role = "literal"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = os.environ.get("JSECON_NOTEBOOKS", "cache")
nb_execution_timeout = 600
nb_merge_streams = True
nb_execution_raise_on_error = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"jsecon {release}"
html_static_path = ["_static"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#9a3412", "color-brand-content": "#9a3412"},
    "dark_css_variables": {"color-brand-primary": "#fb923c", "color-brand-content": "#fb923c"},
}
html_math_renderer = "mathml"


def _as_mathml(display: str) -> Any:
    """Returns the visitor that writes a formula as MathML, "inline" or as a "block"."""

    def visit(translator: Any, node: nodes.Element) -> None:
        mathml = latex2mathml.converter.convert(node.astext(), display=display)
        if display == "inline":
            translator.body.append(mathml)
        else:
            number = f' <span class="eqno">({node["number"]})</span>' if node.get("number") else ""
            anchor = f' id="equation-{node["label"]}"' if node.get("label") else ""
            translator.body.append(f'<div class="math"{anchor}>{mathml}{number}</div>\n')
        raise nodes.SkipNode

    return visit


def _shorten_types(app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str) -> Any:
    """Writes `Float[Array, "n 3"]` for jaxtyping's unions over the kinds of arrays."""

    def shorten(text: str | None) -> str | None:
        if text is None:
            return None
        text = text.replace("jaxlib._jax.Array", "Array").replace("jax._src.basearray.Array", "Array")
        text = re.sub(r"(\w+\[)Array(, '[^']*'\]) \| \1ndarray\2", r"\1Array\2", text)
        return text.replace("Array | ndarray", "Array")

    return shorten(signature), shorten(returns)


class CommandHelp(SphinxDirective):
    """The directive `jsecon-help`: a section for each verb, with what --help prints."""

    def run(self) -> list[nodes.Node]:
        """Returns the sections."""
        os.environ["COLUMNS"] = "92"
        sections = []
        for verb in (kind.__name__.lower() for kind in verbs.VERBS):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
                cli.parse([verb, "--help"])
            section = nodes.section("", nodes.title(text=f"jsecon {verb}"), ids=[f"jsecon-{verb}"])
            lines = [textwrap.fill(line, 92) if len(line) > 92 else line for line in printed.getvalue().splitlines()]
            section += nodes.literal_block("", "\n".join(lines), language="text")
            sections.append(section)
        return sections


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the renderer of formulas and the directive of help texts."""
    app.add_html_math_renderer("mathml", (_as_mathml("inline"), None), (_as_mathml("block"), None))
    app.add_css_file("jsecon.css")
    app.add_directive("jsecon-help", CommandHelp)
    app.connect("autodoc-process-signature", _shorten_types)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
