"""Writes what every exported folder has besides the files of its format."""

from __future__ import annotations

from service.dataset.package import card, croissant, views_table
from service.dataset.package.crate import crate
from service.dataset.package.crate_entities import METADATA
from service.dataset.posed.folder import ExportFolder, json_bytes
from service.dataset.posed.records import DataSet

_DESCRIBED = {
    **card.BESIDE,
    card.NAME: "what this data set is, how it was made, how good it is, and what may be done with it",
}


def write_package(dataset: DataSet, folder: ExportFolder, *, form: str, words: str, description: str) -> None:
    """dataset.json, splits.json, views.csv, the data card, Croissant and RO-Crate; the format's files come before.

    They are written again when an interrupted export goes on, because they depend on the whole record.

    Args:
        dataset: as the format got it.
        folder: with the files of the format.
        form: the format's name.
        words: the format in a few words.
        description: the docstring of its writer, which explains its files.
    """
    about = {"format": form, "version": dataset.about.version, "simulated": dataset.simulated}
    folder.anew("dataset.json", lambda: json_bytes({**dataset.statement, **about}))
    folder.anew("splits.json", lambda: json_bytes({"simulated": dataset.simulated, **dataset.splits.named()}))
    folder.anew(views_table.NAME, lambda: views_table.views_csv(dataset, folder.parts))
    folder.anew(card.NAME, lambda: card.card(dataset, words, description).encode())
    folder.anew(
        croissant.NAME,
        lambda: json_bytes(croissant.croissant(dataset, words, folder.listed(), folder.parts, _DESCRIBED)),
    )
    folder.anew(METADATA, lambda: json_bytes(crate(dataset, words, folder.listed(), _DESCRIBED)))
