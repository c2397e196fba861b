"""Writes every generated page of docs/reference, and the rooms of service/ where they are named."""

from docs.generate.pages import REFERENCE, pages
from docs.generate.rooms import pages_with_rooms

for name, text in pages().items():
    (REFERENCE / name).write_text(text, encoding="utf-8")
for path, text in pages_with_rooms().items():
    path.write_text(text, encoding="utf-8")
