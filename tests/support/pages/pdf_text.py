"""Reads a PDF back with pypdf: the text of its pages, and the tags for screen readers."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, cast

from pypdf import PdfReader


def reader_of(pdf: bytes) -> PdfReader:
    return PdfReader(io.BytesIO(pdf))


def root_of(pdf: bytes) -> Mapping[str, Any]:
    """The document's catalogue."""
    return cast("Mapping[str, Any]", reader_of(pdf).trailer["/Root"].get_object())


def fonts_of(pdf: bytes) -> set[str]:
    """Names of the fonts used."""
    pages = [cast("Mapping[str, Any]", page) for page in reader_of(pdf).pages]
    return {str(font.get_object()["/BaseFont"]) for page in pages for font in page["/Resources"]["/Font"].values()}


@lru_cache(maxsize=2)
def pages_of(pdf: bytes) -> tuple[str, ...]:
    """The text of each page, in order, with white space normalised; half a second of work, so the last are kept."""
    return tuple(" ".join(page.extract_text().split()) for page in reader_of(pdf).pages)


def tags_of(pdf: bytes) -> list[tuple[str, str]]:
    """Every tag in reading order with its alternative text, or ""."""
    return list(_below(root_of(pdf)["/StructTreeRoot"]))


def _below(element: Any) -> Iterator[tuple[str, str]]:
    kids = element.get("/K", [])
    for kid in kids if isinstance(kids, list) else [kids]:
        there = kid.get_object()
        if isinstance(there, dict) and "/S" in there:
            yield str(there["/S"]).removeprefix("/"), str(there.get("/Alt", ""))
            yield from _below(there)
