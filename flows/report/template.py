"""The templates that all reports share, filled."""

import base64
import functools
from pathlib import Path
from typing import Any

import jinja2

TEMPLATES = Path(__file__).parent / "templates"


@functools.cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        # A page shows texts of files and errors: nothing of them is markup.
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def filled(name: str, **values: Any) -> str:
    """A page made of a template, with the style sheet of all of them."""
    style = (TEMPLATES / "style.css").read_text()
    return _environment().get_template(name).render(style=style, **values)


def address(content: bytes | None, mime: str) -> str:
    """A file as an address that holds it; empty for none."""
    return f"data:{mime};base64,{base64.b64encode(content).decode()}" if content else ""
