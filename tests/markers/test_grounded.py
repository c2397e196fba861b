"""Grounding DINO and SAM 2 as a detector: loading offline, tiles, thresholds, outlines, votes, evidence."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.compute.markers.detect import detect_spheres
from service.compute.markers.grounded import (
    DEVIATION,
    LAST_THRESHOLD,
    MEAN,
    VARIABLE,
    Floats,
    GroundedDetector,
    Networks,
    Weights,
    find_boxes,
    load_networks,
    normalised,
    tiles_of,
    voted,
    weights_in,
)
from service.core.errors import ConfigurationError, DataError
from tests.support.grounded_weights import tiny_weights
from tests.support.rig.rig import REPOSITORY
from tests.support.scenes.sphere_images import CONTROL_M, REGISTRATION_M, exact_outlines, render, scene

EVERY = np.vstack([REGISTRATION_M, CONTROL_M])
SIZE_PX = (800, 1333)


def _white(images: Floats) -> NDArray[np.bool_]:
    """(B, h, w): where normalised images show the white spheres of the rendered scenes."""
    rgb = np.moveaxis(images, 1, -1) * np.array(DEVIATION, dtype=np.float32) + np.array(MEAN, dtype=np.float32)
    return np.asarray(rgb.min(axis=-1) > 0.5, dtype=np.bool_)


def colour_boxes(images: Floats) -> tuple[Floats, Floats]:
    """In the place of Grounding DINO: what has the spheres' colour, the larger the more certain."""
    scores = np.zeros((len(images), 40), dtype=np.float32)
    boxes = np.zeros((len(images), 40, 4), dtype=np.float32)
    for k, seen in enumerate(_white(images)):
        height, width = seen.shape
        _, _, found, _ = cv2.connectedComponentsWithStats(seen.astype(np.uint8))
        rows = sorted((row for row in found[1:] if row[4] > 30), key=lambda row: -int(row[4]))[:40]
        for i, (x, y, w, h, area) in enumerate(rows):
            scores[k, i] = 0.9 if area > 400 else 0.2
            boxes[k, i] = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
    return scores, boxes


def grey_masks(images: Floats) -> Floats:
    """In the place of SAM 2: what is as bright as the white spheres, in a channel that is given as a grey picture."""
    grey = images[:, 0] * np.float32(DEVIATION[0]) + np.float32(MEAN[0])
    return np.ascontiguousarray(grey - np.float32(0.5))[:, ::4, ::4]


COLOURS = Networks(colour_boxes, grey_masks, SIZE_PX, 384, "cpu")


needs_torch = pytest.mark.packages("torch")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Weights:
    """Both networks with random weights, as a site would put them in place; one thread: tests use all cores."""
    importlib.import_module("torch").set_num_threads(1)
    return weights_in(tiny_weights(tmp_path_factory.mktemp("weights")))


def test_without_weights_the_message_names_the_files_and_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(ConfigurationError) as none:
        weights_in()
    assert VARIABLE in str(none.value)
    assert "grounding-dino-base" in none.value.remedy
    (tmp_path / "sam2").mkdir()
    (tmp_path / "sam2" / "config.json").write_text("{}")
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(ConfigurationError, match=r"grounding-dino/model.safetensors.*sam2/model.safetensors") as some:
        weights_in()
    assert "sam2/config.json," not in str(some.value).split("weights are missing")[1].split("\n")[0]


@needs_torch
@pytest.mark.slow
def test_both_networks_are_loaded_offline_and_search_an_image(tiny: Weights, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    networks = load_networks(tiny)
    made = scene(1, width=480, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    scores, boxes = networks.boxes(normalised(image, (240, 160)))
    assert scores.shape == (1, 20)
    assert boxes.shape == (1, 20, 4)
    assert ((scores > 0) & (scores < 1)).all()
    masks = networks.masks(normalised(image, (networks.side_px, networks.side_px)))
    assert masks.shape == (1, 32, 32)
    again = load_networks(tiny)
    assert np.array_equal(again.boxes(normalised(image, (240, 160)))[1], boxes), "the same weights, the same boxes"
    # Random networks find boxes anywhere; only where there is a sphere do the edges confirm one.
    exact, _ = exact_outlines(made, 0, EVERY)
    for outline in GroundedDetector(networks, 5).detect(image, made.camera):
        assert min(np.arccos(np.clip(outline.cone.axis @ e.cone.axis, -1, 1)) for e in exact) < 0.01


@pytest.mark.slow
@needs_torch
def test_boxes_are_those_of_the_models_own_program(tiny: Weights) -> None:
    torch, transformers, pillow = (
        importlib.import_module(name) for name in ("torch", "transformers.models.grounding_dino", "PIL.Image")
    )
    picture = np.random.default_rng(3).integers(0, 255, (160, 240, 3), dtype=np.uint8)
    processor = transformers.GroundingDinoImageProcessorPil.from_pretrained(str(tiny.boxes))
    inputs = processor(images=pillow.fromarray(picture[:, :, ::-1]), return_tensors="pt")
    ours = normalised(picture, (240, 160))
    assert np.abs(ours - inputs["pixel_values"].numpy()).max() < 1e-5
    model = transformers.GroundingDinoForObjectDetection.from_pretrained(str(tiny.boxes)).eval()
    words = torch.tensor([[2, 6, 5, 3]])  # [CLS] spheres . [SEP]
    with torch.inference_mode():
        expected = model(input_ids=words, token_type_ids=0 * words, attention_mask=1 + 0 * words, **inputs)
    scores, boxes = load_networks(tiny).boxes(ours)
    assert np.allclose(boxes, expected.pred_boxes.numpy(), atol=1e-5)
    assert np.allclose(scores, torch.sigmoid(expected.logits).max(-1)[0].numpy(), atol=1e-5)


@pytest.mark.slow
@needs_torch
@pytest.mark.parametrize("how", ["damaged", pytest.param("another network", marks=pytest.mark.sweep)])
def test_other_weights_are_refused(tiny: Weights, tmp_path: Path, how: str) -> None:
    for model in ("grounding-dino", "sam2"):
        (tmp_path / model).mkdir()
        for file in (tiny.folder / model).iterdir():
            (tmp_path / model / file.name).write_bytes(file.read_bytes())
    wrong = tmp_path / "sam2" / "model.safetensors"
    wrong.write_bytes(b"\0" * 900 if how == "damaged" else (tiny.boxes / "model.safetensors").read_bytes())
    with pytest.raises(DataError, match="Sam2Model") as told:
        load_networks(weights_in(tmp_path))
    assert told.value.where == str(tmp_path / "sam2")


@pytest.mark.slow
def test_boxes_masks_and_edges_give_the_outlines() -> None:
    made = scene(1, width=1200, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    exact, _ = exact_outlines(made, 0, EVERY, margin_px=60)
    found = GroundedDetector(COLOURS, len(EVERY)).detect(image, made.camera)
    near = [min(np.arccos(np.clip(e.cone.axis @ o.cone.axis, -1, 1)) for o in found) * made.camera.fx for e in exact]
    assert np.mean(np.array(near) < 0.3) >= 0.7, near


def test_a_large_image_is_searched_in_tiles_and_each_sphere_once() -> None:
    tiles = tiles_of(9504, 6336, SIZE_PX)
    assert (tiles[0].left, tiles[0].right, tiles[0].bottom) == (0, 9504, 6336)
    covered = np.zeros((64, 96), dtype=int)
    for tile in tiles[1:]:
        assert 0 <= tile.left < tile.right <= 9504
        assert 0 <= tile.top < tile.bottom <= 6336
        covered[tile.top // 100 : tile.bottom // 100 + 1, tile.left // 100 : tile.right // 100 + 1] += 1
    assert covered.min() >= 1
    assert len(tiles_of(1920, 1280, SIZE_PX)) == 1
    made = scene(1, width=1500, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    once = find_boxes(image, COLOURS, len(EVERY))
    small = replace(COLOURS, size_px=(250, 380))  # as if the image were four times as large
    assert len(tiles_of(1500, 1000, small.size_px)) > 4
    tiled = find_boxes(image, small, len(EVERY))
    centres = [np.array([np.add(b[:2], b[2:]) / 2 for b in boxes]) for boxes in (once, tiled)]
    gaps = np.linalg.norm(centres[0][:, None] - centres[1], axis=2)
    assert (gaps.min(axis=1) < 4).all(), "every sphere is found in the tiles too"
    assert (np.sort(gaps, axis=1)[:, 1] > 20).all(), "and once"


def test_the_threshold_falls_until_enough_spheres_are_found() -> None:
    asked: list[int] = []

    def boxes(images: Floats) -> tuple[Floats, Floats]:
        asked.append(len(images))
        scores = np.array([[0.5, 0.3, 0.2, 0.12, 0.05]], dtype=np.float32)
        middles = np.array([[0.1 + 0.2 * k, 0.5, 0.06, 0.06] for k in range(5)], dtype=np.float32)
        return scores, middles[None]

    image = np.zeros((600, 600, 3), dtype=np.uint8)
    networks = replace(COLOURS, boxes=boxes)
    assert [len(find_boxes(image, networks, least)) for least in (1, 2, 3, 4, 5)] == [1, 2, 3, 4, 4]
    assert LAST_THRESHOLD > 0.05, "the fifth is never certain enough"
    assert sum(asked) == 5, "the image is searched once, whatever the threshold"


def test_a_vote_keeps_what_both_find_and_what_one_finds_clearly() -> None:
    made = scene(1, width=900, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    found = detect_spheres(image, made.camera)
    clear = found[0]
    assert clear.score > 0.6
    faint = replace(found[1], score=0.3)
    elsewhere = replace(found[2], score=0.3)
    assert voted([clear, faint], []) == (clear,)
    assert {id(o) for o in voted([faint], [faint, elsewhere])} == {id(faint)}
    assert voted([], [clear, faint]) == (clear,)


@needs_torch
@pytest.mark.slow
@pytest.mark.sweep
def test_all_detectors_are_measured_side_by_side(tiny: Weights, tmp_path: Path) -> None:
    size = ("--images", "1", "--width", "400", "--only", "behind tissue", "--out", str(tmp_path))
    command = [sys.executable, "-m", "bench.markers.detectors", *size]
    subprocess.run(command, cwd=REPOSITORY, env={**os.environ, VARIABLE: str(tiny.folder)}, check=True)
    (table,) = tmp_path.glob("detectors-*.md")
    rows = [line.split("|")[2].strip() for line in table.read_text().splitlines() if line.startswith("| green")]
    assert rows == ["classical", "paper", "grounded", "vote"]
