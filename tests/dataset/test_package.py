"""What every exported folder has beside its format: Croissant, RO-Crate, a data card, and an index of the views."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from service.computations.evaluate import Contribution, ErrorBudget, Row
from service.core.records.data_set import DataSetStatement
from service.dataset.exporter import exporter, exporters, write_data_set
from service.dataset.pixels import undistorted_data_set
from service.dataset.records import About, DataSet, UsedDevice
from tests.support.scenes.croissant import read_croissant
from tests.support.scenes.posed import posed_data_set

if TYPE_CHECKING:
    from mlcroissant import Dataset

# rdflib, which mlcroissant reads JSON-LD with, calls its own deprecated class.
pytestmark = pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated:DeprecationWarning")
PICTURES = {"image", "mask"}
STATED = DataSetStatement(
    title="A lumbar spine",
    licence="https://creativecommons.org/licenses/by/4.0/",
    ethics="Approved by the cantonal committee, 2026-0042",
    creators=("A. Name", "A hospital"),
    cite="Name et al., A lumbar spine, 2026.",
)
ABOUT = About(
    stated=STATED,
    version="1.2.0",
    run="run-1",
    specimen="L1 to L5",
    published_utc="2026-11-23T16:00:00Z",
    devices=(UsedDevice("camera", "ILCE-7RM5", "4711", "2.0"),),
    settings=(("aperture", "f/22"),),
    accuracy=Row(poses="hybrid", mean_radial_error_mm=0.0123, predicted_error_mm=0.02),
    budget=ErrorBudget(
        contributions=(Contribution(name="scan", sigma_mm=0.05, how="stated", counted=True),), total_mm=0.0513
    ),
    fusion=(("Wound", "proposed, then corrected: CT by Grace"),),
    deviations=("the scan was repeated",),
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return dataclasses.replace(posed_data_set(tmp_path_factory.mktemp("photographs")), about=ABOUT)


@pytest.fixture(scope="module", params=sorted(exporters()))
def exported(request: pytest.FixtureRequest, dataset: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / request.param
    write_data_set(dataset, exporter(request.param), folder)
    return folder


def document(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def listed(folder: Path) -> dict[str, str]:
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    return {name: sha256 for sha256, name in (line.split("  ", 1) for line in lines)}


def test_croissant_is_valid_and_its_record_sets_load(exported: Path, dataset: DataSet) -> None:
    loaded = read_croissant(exported)  # raises where it is not valid
    issues = loaded.metadata.ctx.issues
    assert not issues.errors
    assert not issues.warnings
    views = list(loaded.records("views"))
    assert [view["views/name"].decode() for view in views] == [view.name for view in dataset.views]
    shown = exporter(exported.name)
    expected = undistorted_data_set(dataset) if shown.pinhole else dataset
    for record, view in zip(views, expected.views, strict=True):
        position = [record[f"views/{axis}"] for axis in "xyz"]
        turn = Rotation.from_quat([record[f"views/q{axis}"] for axis in "xyzw"]).as_matrix()
        assert np.abs(np.array(position) - view.T_world_camera[:3, 3]).max() < 1e-12
        assert np.abs(turn - view.T_world_camera[:3, :3]).max() < 1e-12
        assert (record["views/fx"], record["views/width"]) == (view.camera.fx, view.camera.width)
        assert record["views/simulated"]
    for role in PICTURES:
        if any(f"views/{role}" in record for record in views):
            check_pictures(loaded, exported, role, [record[f"views/{role}"].decode() for record in views])
    if exported.name in ("nerfstudio", "bop"):  # as 16-bit PNG
        check_depth(exported, expected, [record["views/depth"].decode() for record in views])


def check_pictures(loaded: Dataset, folder: Path, role: str, files: list[str]) -> None:
    name = f"{role}_pixels"
    records = {record[f"{name}/file"].decode(): record[f"{name}/pixels"] for record in loaded.records(name)}
    assert set(records) == set(files)
    for file, pixels in records.items():
        with Image.open(folder / file) as picture:
            assert np.array_equal(np.asarray(pixels), np.asarray(picture.convert("RGB")))


def check_depth(folder: Path, dataset: DataSet, files: list[str]) -> None:
    """The depth that a record names is that of its view, in units of 0.1 mm."""
    for file, view in zip(files, dataset.views, strict=True):
        coded = cv2.imread(str(folder / file), cv2.IMREAD_UNCHANGED)
        assert coded is not None
        assert np.abs(coded * 1e-4 - dataset.pixels.depth_m(view)).max() < 0.51e-4


def test_croissant_refuses_a_file_that_was_altered(dataset: DataSet, tmp_path: Path) -> None:
    """In one format, as every format states its hashes by the same code, and is read by its hashes above."""
    write_data_set(dataset, exporter("plain"), tmp_path / "out")
    table = tmp_path / "out" / "views.csv"
    table.write_bytes(table.read_bytes().replace(b"true", b"false", 1))
    with pytest.raises(Exception, match=r"Download\(views.csv\)"):
        list(read_croissant(tmp_path / "out").records("views"))


def test_ro_crate_lists_every_file_with_its_hash(exported: Path) -> None:
    crate = document(exported / "ro-crate-metadata.json")
    entities = {entity["@id"]: entity for entity in crate["@graph"]}
    assert len(entities) == len(crate["@graph"]), "no identifier twice"
    root = entities["./"]
    assert entities["ro-crate-metadata.json"]["about"] == {"@id": "./"}
    files = {part["@id"] for part in root["hasPart"]}
    assert {name: entities[name]["sha256"] for name in files} == {
        name: sha256 for name, sha256 in listed(exported).items() if name != "ro-crate-metadata.json"
    }
    for name in files:
        assert int(entities[name]["contentSize"]) == (exported / name).stat().st_size
    referred = {
        item["@id"]
        for entity in crate["@graph"]
        for value in entity.values()
        for item in (value if isinstance(value, list) else [value])
        if isinstance(item, dict) and "@id" in item
    }
    assert {one for one in referred if not one.startswith("http")} <= set(entities)
    assert (root["version"], root["creditText"]) == ("1.2.0", STATED.cite)
    assert root["license"] == {"@id": STATED.licence}
    assert entities[STATED.licence]["@type"] == "CreativeWork"
    assert entities["#ethics"]["description"] == STATED.ethics
    assert "SIMULATED" in root["name"]


def test_the_card_tells_what_people_ask(exported: Path) -> None:
    text = (exported / "DATACARD.md").read_text(encoding="utf-8")
    for words in (
        *("# A lumbar spine", "SIMULATED", "1.2.0", "A. Name, A hospital"),
        *(STATED.licence, STATED.ethics, STATED.cite),
        *("ILCE-7RM5", "4711", "f/22", "L1 to L5", "0.012 mm", "| scan | 0.0500 | stated |", "| sum | 0.0513 |"),
        *(
            "**Wound**: proposed, then corrected: CT by Grace",
            "the scan was repeated",
            "T_world_camera",
            "Lengths are metres",
        ),
    ):
        assert words in text, words
    for name in listed(exported):
        if "/" not in name:
            assert name in text or name in ("DATACARD.md", "README.txt", "loader.py"), f"{name} is not explained"


def test_what_nobody_stated_is_said_to_be_missing(dataset: DataSet, tmp_path: Path) -> None:
    bare = dataclasses.replace(dataset, about=About())
    write_data_set(bare, exporter("gltf"), tmp_path / "out")
    text = (tmp_path / "out" / "DATACARD.md").read_text(encoding="utf-8")
    assert "No licence was stated" in text
    assert "No ethics statement was given" in text
    assert "Not evaluated" in text
    assert not read_croissant(tmp_path / "out").metadata.ctx.issues.errors


def test_a_captured_data_set_is_not_called_simulated(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    write_data_set(posed_data_set(tmp_path / "photographs", simulated=False), exporter("plain"), tmp_path / "out")
    for name in ("DATACARD.md", "ro-crate-metadata.json", "croissant.json"):
        assert b"SIMULATED" not in (tmp_path / "out" / name).read_bytes()
    assert '"simulated": true' not in (tmp_path / "out" / "dataset.json").read_text()


def test_views_csv_is_the_same_for_every_reader_of_csv(exported: Path, dataset: DataSet) -> None:
    with (exported / "views.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    by_name = {view.name: view for view in dataset.views}
    for row in rows:
        covariance = np.array([[float(row[f"c{min(i, j)}{max(i, j)}"]) for j in range(6)] for i in range(6)])
        assert np.array_equal(covariance, by_name[row["name"]].covariance)
        for role in {"image", "depth", "mask", "arrays"} & set(row):
            assert hashlib.sha256((exported / row[role]).read_bytes()).hexdigest() == listed(exported)[row[role]]
    assert {row["name"] for row in rows if row["split"] == "test"} == set(dataset.splits.test)
    assert {row["name"] for row in rows if row["sparse"] == "true"} == set(dataset.splits.sparse)
