"""Reads a protocol once, so that the forks of a process need not import and build again what reading one takes."""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
from functools import cache
from pathlib import Path

from pydantic import ValidationError

from service.core.protocol import parse_protocol
from service.core.records.events import PAYLOAD
from service.steps import kinds

_PROTOCOL = Path(__file__).parents[3] / "protocols" / "exvivo_spine.yaml"  # has nearly all kinds of steps


@cache
def read_once() -> None:
    """Import our kinds of steps, and build the models of protocols and events; plug-ins are left to the forks."""
    modules = [
        importlib.import_module(f"{kinds.__name__}.{found.name}") for found in pkgutil.iter_modules(kinds.__path__)
    ]
    params = {module.KIND.name: module.KIND.params for module in modules}
    parse_protocol(_PROTOCOL.read_bytes(), params, name=_PROTOCOL.name)
    with contextlib.suppress(ValidationError):  # no event at all
        PAYLOAD.validate_python({})
