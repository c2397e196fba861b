"""Methods of feature matching, each given two pictures and nothing else: SIFT, LightGlue, LoFTR and plug-ins."""

from __future__ import annotations

import hashlib
import importlib
import pickle
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol as Interface

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.compute.sfm.colmap import SiftFeatures, extract_sift, from_colmap_pixels
from service.compute.sfm.features import match_descriptors
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array
from service.core.loading import declared_kinds, kind_named

GROUP = "orthocapture.matchers"
Picture = NDArray[np.uint8]  # (H, W, 3), blue first


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pixels (M, 2) of matches in both pictures, the first pixel's centre at 0, and the method's confidence (M,)."""

    first_px: Array = field(repr=False)
    second_px: Array = field(repr=False)
    confidence: Array = field(repr=False)


class Match(Interface):
    """A method that is ready to run."""

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures."""
        ...


@dataclass(frozen=True, slots=True)
class Matcher:
    """A matching method.

    Attributes:
        name: its name on the command line.
        words: its label in the table.
        load: makes it ready, with its weights if it has any. Raises ConfigurationError, which says what to install,
            if something is missing, and DataError if the weights are not its own.
        weights: description of its file of weights; "" if it has none.
    """

    name: str
    words: str
    load: Callable[[Path | None], Match]
    weights: str = ""


def matchers() -> dict[str, Matcher]:
    """Return every method by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.compute.matching.methods", GROUP, Matcher)


def matcher(name: str) -> Matcher:
    """Return the method of this name.

    Raises:
        ConfigurationError: there is none.
    """
    return kind_named(name, matchers(), what="matching method", option="--method")


SIFT_FEATURES = 8192  # COLMAP's default
FIRST_OCTAVE = -1  # COLMAP's default: the image is doubled first


class ExtractedSift:
    """Features of pictures, cached for the pairs that follow."""

    def __init__(self) -> None:
        self._known: dict[bytes, SiftFeatures] = {}

    def of(self, picture: Picture) -> SiftFeatures:
        """Return the features of a picture, extracted once."""
        key = hashlib.blake2b(picture.tobytes()).digest()
        if key not in self._known:
            grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            self._known[key] = extract_sift(grey, SIFT_FEATURES, FIRST_OCTAVE)
        return self._known[key]


class Sift:
    """COLMAP's SIFT; the confidence of a match is the cosine of its descriptors."""

    def __init__(self) -> None:
        self._features = ExtractedSift()

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures."""
        a, b = self._features.of(first), self._features.of(second)
        rows = match_descriptors(a.descriptors, b.descriptors)
        pairs = a.descriptors[rows[:, 0]].astype(np.float64), b.descriptors[rows[:, 1]].astype(np.float64)
        length = np.linalg.norm(pairs[0], axis=1) * np.linalg.norm(pairs[1], axis=1)
        cosine = np.sum(pairs[0] * pairs[1], axis=1) / np.maximum(length, 1e-12)
        first_px, second_px = (from_colmap_pixels(f.points[rows[:, k]]) for k, f in enumerate((a, b)))
        return Matches(first_px, second_px, cosine)


def _load_sift(_weights: Path | None) -> Sift:
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value  # it announces each extraction
    return Sift()


SIFT = Matcher("sift", "SIFT (COLMAP), mutual nearest neighbours, ratio 0.8", _load_sift)


INSTALL = 'pip install "kornia==0.9.0" "torch>=2.5.1"'
Floats = NDArray[np.float32]


class Tensor(Interface):
    """The part of torch.Tensor that is used here."""

    def numpy(self) -> NDArray[np.generic]:
        """Return its values."""
        ...


Weights = Mapping[str, Tensor]


class LoadReport(Interface):
    """The result of loading weights."""

    @property
    def missing_keys(self) -> list[str]:
        """Parameters and buffers without weights."""
        ...


class Network(Interface):
    """The part of torch.nn.Module that is used here."""

    def load_state_dict(self, state_dict: Weights, strict: bool) -> LoadReport:
        """Set the weights."""
        ...

    def named_parameters(self) -> Iterable[tuple[str, object]]:
        """Return the names and values of the learned parameters."""
        ...

    def eval(self) -> object:
        """Switch to inference."""
        ...

    def __call__(self, data: Mapping[str, object]) -> Mapping[str, Tensor]:
        """Run it."""
        ...


@dataclass(frozen=True, slots=True)
class Torch:
    """The functions of PyTorch that are used, and a class of kornia's."""

    make: Callable[..., Network]
    tensor: Callable[[Floats], Tensor]
    load: Callable[..., object]
    inference: Callable[[], AbstractContextManager[object]]


def torch_with(network: str, words: str) -> Torch:
    """Return PyTorch, with the class of kornia.feature of this name.

    Raises:
        ConfigurationError: one of both is not installed.
    """
    try:
        torch, kornia = (vars(importlib.import_module(name)) for name in ("torch", "kornia.feature"))
    except ImportError as error:
        raise ConfigurationError(
            f"{error.name} is not installed, which {words} needs", remedy=f"Run {INSTALL} in this environment"
        ) from error
    return Torch(kornia[network], torch["from_numpy"], torch["load"], torch["inference_mode"])


def read_weights(torch: Torch, path: Path | None, expected: str) -> Weights:
    """Read the weights in a local file; nothing is downloaded, and no code in the file is run.

    Raises:
        ConfigurationError: no file is named.
        DataError: the file is missing or holds something else.
    """
    if path is None:
        raise ConfigurationError(
            "this method needs its weights", where="--weights", remedy=f"Download {expected}, and give --weights FILE"
        )
    remedy = f"Give the file {expected}"
    try:
        found = torch.load(str(path), map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise DataError("these weights cannot be read", where=str(path), remedy=remedy) from error
    inner = found.get("state_dict", found) if isinstance(found, dict) else None
    if not isinstance(inner, dict):
        raise DataError("this file holds no weights", where=str(path), remedy=remedy)
    return {str(name): value for name, value in inner.items()}


def set_weights(network: Network, weights: Weights, path: Path | None, expected: str) -> None:
    """Load all weights of a network, and switch it to inference.

    Raises:
        DataError: they are those of another network.
    """
    try:
        report = network.load_state_dict(weights, strict=False)
    except RuntimeError as error:  # other shapes
        raise _foreign(path, expected) from error
    learned = {str(name) for name, _ in network.named_parameters()}
    if learned & set(report.missing_keys):
        raise _foreign(path, expected)
    network.eval()


def _foreign(path: Path | None, expected: str) -> DataError:
    return DataError("these are the weights of another network", where=str(path), remedy=f"Give the file {expected}")


def grey_0_to_1(picture: Picture, size: tuple[int, int]) -> Floats:
    """Return (1, 1, h, w) grey values from 0 to 1, resized to a width and height."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(np.asarray(grey, dtype=np.uint8), size, interpolation=cv2.INTER_AREA)
    return (np.asarray(small, dtype=np.float32) / np.float32(255.0))[None, None]


LIGHTGLUE_WEIGHTS = "sift_lightglue.pth (release v0.1_arxiv of LightGlue, for SIFT)"
LIGHTGLUE_FEATURES = 2048  # with which its pose errors were published (Lindenberger et al., ICCV 2023)
_LAYERS = 9


class LightGlue:
    """The network with its weights."""

    def __init__(self, torch: Torch, network: Network) -> None:
        self._torch, self._network = torch, network
        self._features = ExtractedSift()

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures."""
        a, b = (strongest(self._features.of(picture)) for picture in (first, second))
        with self._torch.inference():
            found = self._network({"image0": self._data(a, first), "image1": self._data(b, second)})
        partner = np.asarray(found["matches0"].numpy(), dtype=np.int64)[0]
        confidence = np.asarray(found["matching_scores0"].numpy(), dtype=np.float64)[0]
        rows = np.flatnonzero(partner >= 0)
        first_px, second_px = from_colmap_pixels(a.points[rows]), from_colmap_pixels(b.points[partner[rows]])
        return Matches(first_px, second_px, confidence[rows])

    def _data(self, features: SiftFeatures, picture: Picture) -> Mapping[str, object]:
        """Return LightGlue's inputs for an image: lengths in pixels, angles in radians, descriptors of length 1."""
        descriptors = features.descriptors.astype(np.float32)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), np.float32(1e-6))
        arrays = {
            "keypoints": features.points,
            "scales": features.scales_px,
            "oris": features.orientations_rad,
            "descriptors": descriptors,
        }
        data: dict[str, object] = {k: self._torch.tensor(v.astype(np.float32)[None]) for k, v in arrays.items()}
        height, width = picture.shape[:2]
        return data | {"image_size": self._torch.tensor(np.array([[width, height]], dtype=np.float32))}


def strongest(features: SiftFeatures) -> SiftFeatures:
    """Return the LIGHTGLUE_FEATURES features with the largest scales, in their order."""
    kept = np.sort(np.argsort(-features.scales_px, kind="stable")[:LIGHTGLUE_FEATURES])
    return SiftFeatures(
        features.points[kept], features.scales_px[kept], features.orientations_rad[kept], features.descriptors[kept]
    )


def present_names(weights: Weights) -> Weights:
    """Return the weights by the names that the network has today; the published file has older ones."""
    renamed: dict[str, str] = {name: name for name in weights}
    for layer in range(_LAYERS):
        for block in ("self_attn", "cross_attn"):
            old, new = f"{block}.{layer}.", f"transformers.{layer}.{block}."
            renamed = {name: now.replace(old, new) if now.startswith(old) else now for name, now in renamed.items()}
    return {renamed[name]: value for name, value in weights.items()}


def _load_lightglue(weights: Path | None) -> LightGlue:
    torch = torch_with("LightGlue", "LightGlue")
    # As kornia sets it up for SIFT; with the name of the features it would download the weights.
    network = torch.make(features=None, input_dim=128, add_scale_ori=True)
    set_weights(network, present_names(read_weights(torch, weights, LIGHTGLUE_WEIGHTS)), weights, LIGHTGLUE_WEIGHTS)
    return LightGlue(torch, network)


LIGHTGLUE = Matcher("lightglue", "LightGlue (kornia 0.9.0) on COLMAP's SIFT", _load_lightglue, LIGHTGLUE_WEIGHTS)


LOFTR_WEIGHTS = (
    "loftr_outdoor.ckpt (12 million parameters, trained on MegaDepth; linked in kornia's feature/loftr/loftr.py)"
)
LONGER_SIDE_PX = 840  # at which LoFTR was trained and its pose errors were published (Sun et al., CVPR 2021)
_CELL = 8  # pixels in a cell of the coarse level: sizes are multiples of it


class LoFTR:
    """The network with its weights."""

    def __init__(self, torch: Torch, network: Network) -> None:
        self._torch, self._network = torch, network

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures, reduced to LONGER_SIDE_PX."""
        sizes = [reduced_size(picture) for picture in (first, second)]
        inputs = [
            self._torch.tensor(grey_0_to_1(picture, size))
            for picture, size in zip((first, second), sizes, strict=True)
        ]
        with self._torch.inference():
            found = self._network({"image0": inputs[0], "image1": inputs[1]})
        pixels = [
            original_px(np.asarray(found[name].numpy(), dtype=np.float64), size, picture)
            for name, size, picture in zip(("keypoints0", "keypoints1"), sizes, (first, second), strict=True)
        ]
        return Matches(pixels[0], pixels[1], np.asarray(found["confidence"].numpy(), dtype=np.float64))


def reduced_size(picture: Picture) -> tuple[int, int]:
    """Return the width and height at which the network sees a picture."""
    height, width = picture.shape[:2]
    factor = min(1.0, LONGER_SIDE_PX / max(height, width))
    return max(1, round(factor * width / _CELL)) * _CELL, max(1, round(factor * height / _CELL)) * _CELL


def original_px(points: Array, size: tuple[int, int], picture: Picture) -> Array:
    """Return our pixels (M, 2) of the network's points (M, 2), whose first pixel has its centre at 0.5."""
    height, width = picture.shape[:2]
    return points * (np.array([width, height]) / np.array(size)) - 0.5


def _load_loftr(weights: Path | None) -> LoFTR:
    torch = torch_with("LoFTR", "LoFTR")
    network = torch.make(pretrained=None)
    state = {
        name.removeprefix("matcher."): value for name, value in read_weights(torch, weights, LOFTR_WEIGHTS).items()
    }
    set_weights(network, state, weights, LOFTR_WEIGHTS)
    return LoFTR(torch, network)


LOFTR = Matcher("loftr", "LoFTR (kornia 0.9.0), outdoor weights, 840 px", _load_loftr, LOFTR_WEIGHTS)

KINDS = (SIFT, LIGHTGLUE, LOFTR)
