"""Who made a data set, and its licence, as machines read them: RO-Crate 1.1, Croissant (by mlcroissant), the card.

The identifiers are public ones whose check digits are right: ORCID's own example, and bodies in ROR.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from service.core.errors import DataError
from service.core.protocol import load_protocol
from service.core.records.data_set import DataSetStatement, Party, doi_address, licence_address, party
from service.dataset.exporter import exporter, write_data_set
from service.dataset.records import About, DataSet
from service.steps import params_models
from service.steps.protocol_check import implausible
from tests.support.rig.rig import REPOSITORY
from tests.support.scenes.croissant import read_croissant

# rdflib, which mlcroissant reads JSON-LD with, calls its own deprecated class.
pytestmark = pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated:DeprecationWarning")
ORCID, ROR, SPDX = "https://orcid.org/", "https://ror.org/", "https://spdx.org/licenses/"
JOSIAH = f"{ORCID}0000-0002-1825-0097"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("Lastname, Firstname", Party("Lastname, Firstname", "Person")),  # the case f14
        ("Carberry, Josiah 0000-0002-1825-0097", Party("Carberry, Josiah", "Person", JOSIAH)),
        ("Josiah Carberry (https://orcid.org/0000-0002-1825-0097)", Party("Josiah Carberry", "Person", JOSIAH)),
        ("Ana <orcid:000000021694233x>", Party("Ana", "Person", f"{ORCID}0000-0002-1694-233X")),
        ("ETH Zurich https://ror.org/05a28rw58", Party("ETH Zurich", "Organization", f"{ROR}05a28rw58")),
        ("Uniandes ROR.org/02MHBDP94", Party("Uniandes", "Organization", f"{ROR}02mhbdp94")),
        ("Harvard 03vek6s52", Party("Harvard", "Organization", f"{ROR}03vek6s52")),
        ("Institute of Örtho", Party("Institute of Örtho", "Organization")),
        ("Universitätsspital Basel", Party("Universitätsspital Basel", "Organization")),
        ("Balgrist AG", Party("Balgrist AG", "Organization")),
        ("Sa, Ana", Party("Sa, Ana", "Person")),
        ("organisation: Balgrist", Party("Balgrist", "Organization")),
        ("person: Institoris, Ana", Party("Institoris, Ana", "Person")),
    ],
)  # fmt: skip
def test_a_line_names_a_person_or_a_body(line: str, expected: Party) -> None:
    assert party(line) == expected


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Carberry, Josiah 0000-0002-1825-0098", "its check digit is wrong"),
        ("Carberry, Josiah 0000-0002-1825-009", "four groups of four digits"),
        ("Carberry, Josiah https://orcid.org/1825", "four groups of four digits"),
        ("ETH Zurich https://ror.org/05a28rw59", "the ROR is mistyped"),
        ("ETH Zurich https://ror.org/05a28", "the ROR is mistyped"),
        ("0000-0002-1825-0097", "the name is missing"),
        ("person: ETH Zurich ror.org/05a28rw58", "people have an ORCID, bodies a ROR"),
    ],
)
def test_a_mistyped_identifier_is_refused(line: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        party(line)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("CC-BY-4.0", f"{SPDX}CC-BY-4.0"),
        ("cc-by-nc-sa-3.0-igo", f"{SPDX}CC-BY-NC-SA-3.0-IGO"),
        ("CC0-1.0", f"{SPDX}CC0-1.0"),
        ("odbl-1.0", f"{SPDX}ODbL-1.0"),
        ("https://creativecommons.org/licenses/by/4.0/", "https://creativecommons.org/licenses/by/4.0/"),
    ],
)
def test_a_licence_is_an_spdx_identifier_or_an_address(text: str, address: str) -> None:
    assert licence_address(text) == address


@pytest.mark.parametrize(
    ("text", "meant"),
    [("CC BY 4.0", "CC-BY-4.0"), ("Creative Commons Attribution 4.0", "CC-BY-4.0"), ("ODbL", "ODbL-1.0")],
)
def test_the_licence_that_is_meant_is_named(text: str, meant: str) -> None:
    with pytest.raises(DataError) as caught:
        licence_address(text)
    assert f"Did you mean {meant}?" in caught.value.remedy


def test_a_doi_has_one_address() -> None:
    for text in ("10.5281/zenodo.1", "doi:10.5281/zenodo.1", "https://dx.doi.org/10.5281/zenodo.1"):
        assert doi_address(text) == "https://doi.org/10.5281/zenodo.1"
    with pytest.raises(DataError, match="this is not a DOI"):
        doi_address("zenodo.1")


STATED = DataSetStatement(
    licence="CC-BY-4.0",
    creators=("Carberry, Josiah 0000-0002-1825-0097", "Balgrist University Hospital", "ETH Zurich ror.org/05a28rw58"),
    doi="10.5281/zenodo.1234567",
    publisher="ETH Zurich ror.org/05a28rw58",
    funders=("Swiss National Science Foundation https://ror.org/00yjd3n13", "A fund"),
)


@pytest.fixture(scope="module")
def exported(dataset: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "out"
    write_data_set(dataclasses.replace(dataset, about=About(stated=STATED, run="run-1")), exporter("gltf"), folder)
    return folder


def test_the_crate_names_people_bodies_and_licence_by_their_addresses(exported: Path) -> None:
    crate: Any = json.loads((exported / "ro-crate-metadata.json").read_text(encoding="utf-8"))
    entities = {entity["@id"]: entity for entity in crate["@graph"]}
    assert len(entities) == len(crate["@graph"]), "ETH made and publishes it, and is one entity"
    root = entities["./"]
    orcid, eth = f"{ORCID}0000-0002-1825-0097", f"{ROR}05a28rw58"
    makers = [entities[one["@id"]] for one in root["creator"]]
    assert [(one["@type"], one["name"]) for one in makers] == [
        ("Person", "Carberry, Josiah"),
        ("Organization", "Balgrist University Hospital"),
        ("Organization", "ETH Zurich"),
    ]  # fmt: skip
    assert makers[0] == {
        "@id": orcid, "@type": "Person", "name": "Carberry, Josiah", "familyName": "Carberry", "givenName": "Josiah",
    }  # fmt: skip
    assert makers[2]["@id"] == eth
    assert root["publisher"] == {"@id": eth}
    assert [entities[one["@id"]]["name"] for one in root["funder"]] == ["Swiss National Science Foundation", "A fund"]
    assert root["license"] == {"@id": f"{SPDX}CC-BY-4.0"}
    assert entities[f"{SPDX}CC-BY-4.0"]["name"] == "CC-BY-4.0"
    assert root["identifier"] == ["https://doi.org/10.5281/zenodo.1234567", "run-1"]
    assert "10.5281/zenodo.1234567" in root["creditText"]


def test_mlcroissant_reads_them_too(exported: Path) -> None:
    read = read_croissant(exported).metadata
    assert not read.ctx.issues.errors
    assert not read.ctx.issues.warnings
    assert read.license == [f"{SPDX}CC-BY-4.0"]
    assert [(type(one).__name__, one.name, one.url) for one in read.creators] == [
        ("Person", "Carberry, Josiah", f"{ORCID}0000-0002-1825-0097"),
        ("Organization", "Balgrist University Hospital", None),
        ("Organization", "ETH Zurich", f"{ROR}05a28rw58"),
    ]
    assert [one.name for one in read.publisher] == ["ETH Zurich"]
    assert read.url == "https://doi.org/10.5281/zenodo.1234567"


def test_the_card_tells_them_to_people(exported: Path) -> None:
    card = (exported / "DATACARD.md").read_text(encoding="utf-8")
    for words in (
        f"**Licence**: CC-BY-4.0 ({SPDX}CC-BY-4.0)",
        f"**Made by**: Carberry, Josiah ({ORCID}0000-0002-1825-0097), Balgrist University Hospital, ETH Zurich",
        "**DOI**: https://doi.org/10.5281/zenodo.1234567",
        f"**Publisher**: ETH Zurich ({ROR}05a28rw58)",
        f"**Paid for by**: Swiss National Science Foundation ({ROR}00yjd3n13), A fund",
    ):
        assert words in card


def test_a_protocol_with_a_mistyped_identifier_is_told_so_by_line(tmp_path: Path) -> None:
    text = (REPOSITORY / "protocols" / "import_spine.yaml").read_text(encoding="utf-8")
    stated = "data_set:\n  licence: CC BY 4.0\n  creators: [A. Name, B. Name 0000-0002-1825-0098]\n"
    path = tmp_path / "protocol.yaml"
    path.write_text(text + "\n" + stated, encoding="utf-8")
    loaded = load_protocol(path, params_models())  # one that is recorded is read all the same
    told = {problem.field: problem.message for problem in implausible(loaded)}
    assert "Did you mean CC-BY-4.0?" in told["data_set.licence"]
    assert "check digit" in told["data_set.creators[1]"]


def test_what_an_old_record_states_in_words_still_stands_in_the_metadata() -> None:
    about = About(stated=DataSetStatement(licence="ask us", creators=("A. Name 0000-0002-1825-0098",), doi="unknown"))
    assert (about.licence, about.licence_address, about.doi) == ("ask us", "", "")
    assert about.creators == (Party("A. Name 0000-0002-1825-0098", "Person"),)
