"""Which pages are made from the code, and their texts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from service.core.documents.protocol_docs import lifecycle_text, schema_text
from service.core.documents.ways_docs import ways_text
from service.core.protocol.models import load_protocol
from service.steps import params_models

REFERENCE = Path(__file__).parents[1] / "reference"
PROTOCOLS = Path(__file__).parents[2] / "protocols"


def pages() -> Mapping[str, str]:
    """The text of every generated page by its name in docs/reference."""
    exvivo = load_protocol(PROTOCOLS / "exvivo_spine.yaml", params_models()).protocol
    return {
        "protocol.schema.json": schema_text(params_models()),
        "state_machine.md": lifecycle_text(exvivo),
        "ways_on.md": ways_text(exvivo),
    }
