"""A textured scan from the scanner's folder to the data set: mesh, material and picture stay together."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from service.dataset.exporter import exporter, write_data_set
from service.dataset.run_data_set import scan_files
from service.dataset.summary import summarise
from tests.support.ct.fused_scene import CENTRES_M, scan_mesh, with_spheres
from tests.support.runs.bench_run import bench_store
from tests.support.runs.computing_run import TEXTURED, OneScanner, begin_computing_run
from tests.support.scenes.posed import posed_data_set


def write_textured(folder: Path) -> None:
    """An OBJ as trimesh writes it, with its texture moved into a folder and named in capitals."""
    surface = with_spheres(scan_mesh(), CENTRES_M)
    uv = np.random.default_rng(0).uniform(0, 1, (len(surface.vertices_m), 2))
    picture = np.zeros((8, 16, 3), np.uint8)
    picture[..., 2] = 200
    (folder / "tex").mkdir(parents=True)
    tools: Any = trimesh
    visual = tools.visual.TextureVisuals(uv=uv, image=Image.fromarray(picture))
    mesh = trimesh.Trimesh(1e3 * surface.vertices_m, surface.faces, visual=visual, process=False)
    written = tools.exchange.obj.export_obj(mesh, return_texture=True, mtl_name="scan.mtl")
    text, parts = cast("tuple[str, dict[str, bytes]]", written)
    (picture_name,) = [name for name in parts if name.endswith(".png")]
    (folder / "scan.obj").write_text(text)
    material = parts["scan.mtl"].decode().replace(picture_name, "tex/Skin.png")
    (folder / "SCAN.MTL").write_text(material)
    (folder / "tex" / "SKIN.PNG").write_bytes(parts[picture_name])


@pytest.mark.slow
def test_a_textured_scan_leaves_as_it_came(tmp_path: Path) -> None:
    write_textured(tmp_path / "scans")
    rig = OneScanner()
    rig.folder = tmp_path / "scans"
    with bench_store(tmp_path / "data") as store:
        bench = begin_computing_run(store, TEXTURED, tmp_path, rig)
        state = bench.run()
        assert state.status == "completed", state
        assert state.steps["scan"].measures["scan_textures"] == 1
        files = scan_files(summarise(store, bench.run_id, bench.protocol))
        assert {file.name for file in files} == {"scan.obj", "scan.mtl", "tex/Skin.png"}
        (tmp_path / "photographs").mkdir()
        data = dataclasses.replace(posed_data_set(tmp_path / "photographs", 2), scan_files=files)
        write_data_set(data, exporter("plain"), tmp_path / "set")
    loaded: Any = trimesh.load_mesh(tmp_path / "set" / "scan" / "scan.obj", process=False)
    assert loaded.visual.material.image.size == (16, 8)
    assert np.ptp(np.asarray(loaded.vertices), axis=0).max() > 100  # millimetres, as the scanner wrote them
    copy = (tmp_path / "set" / "scan" / "tex" / "Skin.png").read_bytes()
    assert copy == (tmp_path / "scans" / "tex" / "SKIN.PNG").read_bytes()
    assert cv2.imdecode(np.frombuffer(copy, np.uint8), cv2.IMREAD_COLOR) is not None
