"""Blurred and black images are detected from the images themselves and from neighbouring ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.compute.images.photographs import image_quality
from service.steps.retakes import IN_A_ROW, ImageSharpness, last_in_a_row, why_spoilt
from tests.support.scenes.sphere_images import REGISTRATION_M, render, scene

Grey = NDArray[np.uint8]


def photograph(width: int) -> Grey:
    made = scene(1, width=width, seed=2)
    picture = render(made.camera, made.centres_camera(0, REGISTRATION_M))
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def blurred(grey: Grey, sigma_px: float) -> Grey:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px), dtype=np.uint8)


@pytest.mark.parametrize("width", [600, 1536])
def test_edges_are_the_wider_the_more_an_image_is_blurred(width: int) -> None:
    sharp = photograph(width)
    widths = [image_quality(sharp).edge_px, *(image_quality(blurred(sharp, s)).edge_px for s in (1.5, 3.0))]
    assert widths[0] < 4.0
    assert widths[1] > 1.3 * widths[0]
    assert widths[2] > 1.6 * widths[0]
    assert not image_quality(sharp).black


def test_noise_does_not_make_a_blurred_image_sharp() -> None:
    soft = blurred(photograph(960), 4.0).astype(np.float64) + np.random.default_rng(1).normal(0, 2.5, (640, 960))
    assert image_quality(np.clip(soft, 0, 255).astype(np.uint8)).edge_px > 7.0


def test_a_black_image_and_one_without_edges_are_not_measured() -> None:
    black = image_quality(np.random.default_rng(0).integers(0, 6, (400, 600)).astype(np.uint8))
    assert black.black
    assert np.isnan(black.edge_px)
    plain = image_quality(np.full((400, 600), 90, dtype=np.uint8))
    assert not plain.black
    assert np.isnan(plain.edge_px)


def looked(*edges_px: float | None, width: int = 1920) -> list[ImageSharpness]:
    return [ImageSharpness(f"v{i}", f"hash {i}", e, e is None, width) for i, e in enumerate(edges_px)]


def test_an_image_is_judged_by_the_sharpest_beside_it() -> None:
    assert list(why_spoilt(looked(2.6, 2.7, 4.6, 2.5, None))) == ["hash 2", "hash 4"]
    assert why_spoilt(looked(3.4, 3.6, 3.3)) == {}
    assert list(why_spoilt(looked(6.1, 6.2))) == [], "nothing sharper to compare with, and not plainly blurred"
    assert list(why_spoilt(looked(6.1, 6.2), looked(2.6))) == ["hash 0", "hash 1"]


def test_images_that_are_all_blurred_are_found_out_by_size() -> None:
    assert len(why_spoilt(looked(7.5, 7.4, 7.6))) == 3
    assert why_spoilt(looked(7.5, 7.4, 7.6, width=9504)) == {}, "a lens at f/22 draws wider edges on small pixels"


def test_only_several_at_the_end_are_a_row() -> None:
    images = looked(2.5, 9.0, 9.0, 2.5, 9.0, 9.0, 9.0)
    row = last_in_a_row(images, why_spoilt(images))
    assert [image.viewpoint for image in row] == ["v4", "v5", "v6"]
    assert len(row) == IN_A_ROW
    assert last_in_a_row(images[:-1], why_spoilt(images[:-1])) == []
    healed = looked(2.5, 9.0, 9.0, 9.0, 2.5)
    assert last_in_a_row(healed, why_spoilt(healed)) == []
