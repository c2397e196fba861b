"""Keeps compiled templates for all processes of the tests: to compile them takes as long as to show fifty pages."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import jinja2

from service.web import rendering

COMPILED = Path(__file__).parents[3] / "build" / "templates"


@cache
def keep_compiled_templates() -> None:
    """Let this process and its forks use templates that another of the tests has compiled, and add theirs."""
    settings = hashlib.sha256(Path(rendering.__file__).read_bytes()).hexdigest()[:12]
    COMPILED.mkdir(parents=True, exist_ok=True)
    names = f"jinja-{jinja2.__version__}-{settings}-%s.cache"
    rendering.TEMPLATES.bytecode_cache = jinja2.FileSystemBytecodeCache(str(COMPILED), names)
