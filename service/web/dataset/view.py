"""What the page of a data set says: chosen view, chosen split, coverage in words."""

from __future__ import annotations

from dataclasses import dataclass

from service.dataset.preview_records import AT_LEAST, Preview, ViewPreview

SPLITS = ("dense", "sparse", "train", "test")
SPLIT_WORDS = {
    "dense": "all views",
    "sparse": "a few that together see most of the surface",
    "train": "to learn from",
    "test": "to judge by, every eighth",
}


@dataclass(frozen=True, slots=True)
class SplitTab:
    """A split that can be chosen."""

    name: str
    words: str
    count: int


@dataclass(frozen=True, slots=True)
class DataSetView:
    """The page.

    Attributes:
        views: of the chosen split.
        split: the chosen one.
        splits: all.
        chosen: the view that is enlarged; None: there is none yet.
        before, after: names of its neighbours in the split; "" at the ends.
        done: views whose pictures are ready.
        total: of all views.
        crops: of the views of the split.
        covered: (at least so many views, share of the surface).
    """

    views: tuple[ViewPreview, ...]
    split: str
    splits: tuple[SplitTab, ...]
    chosen: ViewPreview | None
    before: str
    after: str
    done: int
    total: int
    crops: int
    covered: tuple[tuple[int, float], ...]


def data_set_view(preview: Preview, split: str, view: str) -> DataSetView:
    """The page for a chosen split and view; the first of the split if the name is none of its views."""
    members = tuple(shown for shown in preview.views if split in shown.splits)
    names = [shown.name for shown in members]
    at = names.index(view) if view in names else 0
    return DataSetView(
        views=members,
        split=split,
        splits=tuple(SplitTab(name, SPLIT_WORDS[name], _count(preview, name)) for name in SPLITS),
        chosen=members[at] if members else None,
        before=names[at - 1] if at > 0 else "",
        after=names[at + 1] if at + 1 < len(names) else "",
        done=sum(shown.ready for shown in preview.views),
        total=len(preview.views),
        crops=sum(len(shown.crops) for shown in members),
        covered=() if preview.coverage is None else tuple(zip(AT_LEAST, preview.coverage.shares, strict=True)),
    )


def _count(preview: Preview, split: str) -> int:
    return sum(split in shown.splits for shown in preview.views)
