"""Methods of feature matching: SIFT itself; of the learned ones, what surrounds the network."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.compute.matching.methods import GROUP, Picture, matcher, matchers
from service.core.errors import ConfigurationError, DataError

# As much of PyTorch and kornia as the adapters use. LoFTR finds everything 8 px to the right and 4 px lower, in its
# own pixels; LightGlue matches each feature with the one at the same index, and gives up the last.
TORCH = """
import contextlib, pickle
import numpy as np

class Tensor:
    def __init__(self, values): self.values = np.asarray(values)
    def numpy(self): return self.values

def from_numpy(values):
    assert values.dtype == np.float32
    return Tensor(values)

def load(path, map_location, weights_only):
    assert weights_only and map_location == "cpu"
    with open(path, "rb") as file:
        return pickle.load(file)

@contextlib.contextmanager
def inference_mode():
    yield
"""
KORNIA = """
import types
import numpy as np
from torch import Tensor

class Network:
    names = ("first.weight", "transformers.0.self_attn.weight")
    def __init__(self, **settings): self.ready = False
    def named_parameters(self): return [(name, None) for name in self.names]
    def load_state_dict(self, state_dict, strict):
        missing = [*set(self.names) - set(state_dict), "derived.buffer"]
        return types.SimpleNamespace(missing_keys=missing)
    def eval(self): self.ready = True

class LoFTR(Network):
    names = ("first.weight",)
    def __init__(self, pretrained):
        assert pretrained is None
    def __call__(self, data):
        assert self.ready
        first, second = data["image0"].values, data["image1"].values
        assert first.shape[:2] == (1, 1) and first.shape[2] % 8 == first.shape[3] % 8 == 0
        assert 0 <= first.min() and first.max() <= 1
        points = np.array([[0.5, 0.5], [80.0, 40.0]])
        return {"keypoints0": Tensor(points), "keypoints1": Tensor(points + [8, 4]), "confidence": Tensor([0.3, 0.9])}

class LightGlue(Network):
    def __init__(self, features, input_dim, add_scale_ori):
        assert (features, input_dim, add_scale_ori) == (None, 128, True)
    def __call__(self, data):
        assert self.ready
        count = data["image0"]["keypoints"].values.shape[1]
        for image in data.values():
            descriptors = image["descriptors"].values
            assert np.allclose(np.linalg.norm(descriptors, axis=2), 1, atol=1e-3)
            assert image["scales"].values.shape == image["oris"].values.shape == descriptors.shape[:2]
            assert (image["keypoints"].values <= image["image_size"].values).all()
        partner = np.arange(count)[None]
        partner[0, -1] = -1
        return {"matches0": Tensor(partner), "matching_scores0": Tensor(np.full((1, count), 0.5))}
"""


@pytest.fixture
def networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with small stand-ins for PyTorch and kornia."""
    for name, text in (("torch", TORCH), ("kornia", ""), ("kornia/feature", KORNIA)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("torch", "kornia", "kornia.feature"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def weights(folder: Path, *names: str) -> Path:
    path = folder / "weights.ckpt"
    path.write_bytes(pickle.dumps({"state_dict": dict.fromkeys(names)}))
    return path


def spotted(width: int, height: int, seed: int = 1) -> Picture:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def test_the_methods_are_found() -> None:
    assert set(matchers()) == {"sift", "loftr", "lightglue"}
    with pytest.raises(ConfigurationError, match="there is no matching method 'magic'"):
        matcher("magic")


def test_a_plug_in_in_one_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "still_matcher.py").write_text(
        "import numpy as np\n"
        "from service.compute.matching.methods import Matcher, Matches\n"
        "def still(first, second):\n"
        "    corners = np.array([[0.0, 0.0], [first.shape[1] - 1.0, 0.0]])\n"
        "    return Matches(corners, corners, np.ones(2))\n"
        "KIND = Matcher('still', 'nothing moves', lambda weights: still)\n",
        encoding="utf-8",
    )
    about = tmp_path / "still_matcher-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: still-matcher\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\nstill = still_matcher:KIND\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    found = matcher("still").load(None)(spotted(64, 48), spotted(64, 48))
    assert found.second_px.tolist() == [[0.0, 0.0], [63.0, 0.0]]


def test_sift_finds_a_shift_to_a_fraction_of_a_pixel() -> None:
    picture, shift = spotted(400, 300), np.array([23.0, -12.0])
    moved = np.asarray(cv2.warpAffine(picture, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (400, 300)), np.uint8)
    found = matcher("sift").load(None)(picture, moved)
    errors = np.linalg.norm(found.second_px - found.first_px - shift, axis=1)
    assert len(errors) > 100
    assert np.median(errors) < 0.05
    assert np.mean(errors < 1) > 0.95
    assert ((found.confidence > 0) & (found.confidence < 1 + 1e-9)).all()


def test_loftr_sees_a_reduced_picture_and_its_matches_are_in_pixels_of_the_original(networks: Path) -> None:
    run = matcher("loftr").load(weights(networks, "matcher.first.weight"))
    found = run(spotted(1680, 1120), spotted(1680, 1120))
    # 1680 × 1120 becomes 840 × 560: two pixels for one of the network's; its first pixel has its centre at 0.5.
    assert np.allclose(found.first_px, [[0.5, 0.5], [159.5, 79.5]])
    assert np.allclose(found.second_px - found.first_px, [16.0, 8.0])
    assert found.confidence.tolist() == [0.3, 0.9]


def test_lightglue_matches_features_of_sift(networks: Path) -> None:
    run = matcher("lightglue").load(weights(networks, "first.weight", "self_attn.0.weight"))
    picture = spotted(320, 240)
    found = run(picture, picture)
    assert len(found.first_px) > 50
    assert (found.first_px == found.second_px).all()
    assert (found.confidence == 0.5).all()


@pytest.mark.parametrize("name", ["loftr", "lightglue"])
def test_a_learned_method_says_what_to_install_and_which_file_to_give(
    name: str, networks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = matcher(name)
    with pytest.raises(ConfigurationError, match="needs its weights") as lacking:
        how.load(None)
    assert "Download" in lacking.value.remedy
    assert how.weights.split()[0] in lacking.value.remedy
    with pytest.raises(DataError, match="cannot be read"):
        how.load(networks / "missing.ckpt")
    with pytest.raises(DataError, match="weights of another network"):
        how.load(weights(networks, "backbone.weight"))
    monkeypatch.setitem(sys.modules, "kornia.feature", None)
    with pytest.raises(ConfigurationError, match=r"kornia\.feature is not installed") as uninstalled:
        how.load(None)
    assert 'pip install "kornia==0.9.0"' in uninstalled.value.remedy
