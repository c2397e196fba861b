"""LightGlue by kornia on COLMAP's SIFT: a learned matcher of features; needs PyTorch and a file of weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from service.compute.matching.methods.method import Matcher, Matches, Picture
from service.compute.matching.methods.networks import Network, Torch, Weights, read_weights, set_weights, torch_with
from service.compute.matching.methods.sift import ExtractedSift
from service.compute.sfm.colmap import SiftFeatures, from_colmap_pixels

WEIGHTS = "sift_lightglue.pth (release v0.1_arxiv of LightGlue, for SIFT)"
MOST_FEATURES = 2048  # with which its pose errors were published (Lindenberger et al., ICCV 2023)
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
    """Return the MOST_FEATURES features with the largest scales, in their order."""
    kept = np.sort(np.argsort(-features.scales_px, kind="stable")[:MOST_FEATURES])
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


def _load(weights: Path | None) -> LightGlue:
    torch = torch_with("LightGlue", "LightGlue")
    # As kornia sets it up for SIFT; with the name of the features it would download the weights.
    network = torch.make(features=None, input_dim=128, add_scale_ori=True)
    set_weights(network, present_names(read_weights(torch, weights, WEIGHTS)), weights, WEIGHTS)
    return LightGlue(torch, network)


KIND = Matcher("lightglue", "LightGlue (kornia 0.9.0) on COLMAP's SIFT", _load, WEIGHTS)
