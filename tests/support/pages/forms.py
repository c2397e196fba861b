"""The forms of a page as a browser would send them."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser

_TYPED = {"reason": "asked", "text": "a note", "meaning": "I have checked this", "pin": "2468"}
_BUTTONS = ("button", "submit")


@dataclass
class PageForm:
    """A form with POST: what it sends by itself, what a person enters in it, and its buttons."""

    action: str
    hidden: dict[str, str] = field(default_factory=dict[str, str])
    entered: dict[str, str] = field(default_factory=dict[str, str])  # the first choice, or words of a test
    buttons: list[dict[str, str]] = field(default_factory=list[dict[str, str]])
    held: bool = False  # its button must be held

    def sent(self, **other: str) -> dict[str, str]:
        """What is sent when a person fills it in and presses its first button; `other` fields for the page's."""
        button = self.buttons[0] if self.buttons else {}
        pressed = {button["name"]: button.get("value", "")} if "name" in button else {}
        return {**self.hidden, **self.entered, **pressed, **other}


class _Forms(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[PageForm] = []
        self._now: PageForm | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "form" and given.get("method") == "post":
            self._now = PageForm(given["action"])
            self.found.append(self._now)
        elif self._now is not None:
            self._take(self._now, tag, given)

    def _take(self, form: PageForm, tag: str, given: dict[str, str]) -> None:
        name, kind = given.get("name", ""), given.get("type", "")
        if tag == "button" and kind in ("", *_BUTTONS):
            form.buttons.append(given)
            form.held = form.held or "data-hold" in given
        elif not name:
            return
        elif tag == "input" and kind == "hidden":
            form.hidden[name] = given.get("value", "")
        elif tag in ("input", "textarea", "select") and kind not in ("file", "checkbox"):
            form.entered.setdefault(name, given.get("value") or _TYPED.get(name, ""))

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._now = None


def forms_of(html: str) -> list[PageForm]:
    """The forms with POST of a page or a part of one, in order."""
    reader = _Forms()
    reader.feed(html)
    return reader.found
