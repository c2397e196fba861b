"""Rules of the pages' templates."""

from __future__ import annotations

import re
from pathlib import Path

TEMPLATES = Path(__file__).parents[2] / "service/web/templates"
HELD = TEMPLATES / "run/macros.html.j2"  # its macro hold_button


def test_every_button_that_must_be_held_is_made_by_one_macro() -> None:
    """A button that is held and does not say so looks broken: three taps, and nothing happens."""
    others = [path for path in TEMPLATES.rglob("*.j2") if "data-hold" in path.read_text() and path != HELD]
    assert others == []
    (button,) = re.findall(r"<button[^>]*\bdata-hold\b.*?</button>", HELD.read_text(), re.DOTALL)
    for said in ('class="ring"', "Hold for 1.5 s.", "{{ note }}"):
        assert said in button, said
