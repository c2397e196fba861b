"""Runs Grounding DINO and SAM 2 as functions on arrays, from a local folder with their weights."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.core.errors import ConfigurationError, DataError

PROMPT = "spheres."  # the paper's; Grounding DINO ends each phrase with a dot
INSTALL = 'pip install "orthocapture[grounded]"'
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the RGB images that both were trained on, 0..1
_SIZE = (800, 1333)  # shorter and longer side at which Grounding DINO was trained
_HALF = 0.5
Floats = NDArray[np.float32]
# PyTorch and transformers have no types that this module could use without installing them.
_Torch = Any


@dataclass(frozen=True, slots=True)
class Networks:
    """Both networks, loaded.

    `boxes` maps (B, 3, h, w) normalised RGB images to scores (B, Q), 0..1, and boxes (B, Q, 4): centre, width and
    height as fractions of the image. `masks` maps (B, 3, s, s) images, s = `side_px`, to (B, m, m) logits of the
    object in the middle.
    """

    boxes: Callable[[Floats], tuple[Floats, Floats]]
    masks: Callable[[Floats], Floats]
    size_px: tuple[int, int]  # shorter and longer side of an image for `boxes`
    side_px: int  # of an image for `masks`
    device: str


def load_networks(weights: Weights) -> Networks:
    """Load both networks with their weights, on the GPU if there is one; nothing is downloaded.

    Raises:
        ConfigurationError: PyTorch or transformers are not installed.
        DataError: the files hold something else.
    """
    try:
        torch, transformers = (importlib.import_module(name) for name in ("torch", "transformers"))
    except ImportError as error:
        raise ConfigurationError(
            f"{error.name} is not installed, which the detector `grounded` needs", remedy=f"Run {INSTALL}"
        ) from error
    transformers.utils.logging.disable_progress_bar()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    detector = _network(weights.boxes, transformers.GroundingDinoForObjectDetection).to(device).eval()
    tokenizer = _read(weights.boxes, transformers.PreTrainedTokenizerFast)
    segmenter = _network(weights.masks, transformers.Sam2Model).to(device).eval()
    return Networks(
        _box_function(torch, detector, tokenizer, device),
        _mask_function(torch, segmenter, device),
        _size(weights.boxes / "preprocessor_config.json"),
        int(segmenter.prompt_encoder.input_image_size),
        device,
    )


def _network(folder: Path, kind: Any) -> Any:
    """Return a network of this class with all of its weights; transformers would leave missing ones at random."""
    network, loaded = _read(folder, kind, output_loading_info=True)
    if missing := sorted(loaded["missing_keys"]):
        raise DataError(
            f"these are not the weights of a {kind.__name__}: {len(missing)} are missing, such as {missing[0]}",
            where=str(folder),
            remedy="Download the files again, and compare their SHA-256",
        )
    return network


def _read(folder: Path, kind: Any, **options: bool) -> Any:
    """Read a model or tokenizer of this class from its folder."""
    try:
        return kind.from_pretrained(str(folder), local_files_only=True, **options)
    # Damaged weights and configurations raise whatever the parsers of these libraries do.
    except Exception as error:
        raise DataError(
            f"this is not a {kind.__name__}: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
            where=str(folder),
            remedy="Download the files again, and compare their SHA-256",
        ) from error


def _box_function(
    torch: _Torch, detector: Any, tokenizer: Any, device: str
) -> Callable[[Floats], tuple[Floats, Floats]]:
    words: Mapping[str, Any] = tokenizer(PROMPT, return_tensors="pt", return_token_type_ids=True)

    def boxes(images: Floats) -> tuple[Floats, Floats]:
        with torch.inference_mode():
            text = {name: tensor.expand(len(images), -1).to(device) for name, tensor in words.items()}
            found = detector(pixel_values=torch.from_numpy(images).to(device), **text)
            # A query's score is that of the word it fits best (Grounding DINO's own post-processing).
            scores = torch.sigmoid(found.logits).amax(dim=-1)
        return scores.cpu().numpy(), found.pred_boxes.cpu().numpy()

    return boxes


def _mask_function(torch: _Torch, segmenter: Any, device: str) -> Callable[[Floats], Floats]:
    def masks(images: Floats) -> Floats:
        # SAM 2's prompt: one point, the middle of the image, which the paper takes to lie in the sphere.
        middle = torch.full((len(images), 1, 1, 2), _HALF * images.shape[-1], device=device)
        with torch.inference_mode():
            found = segmenter(
                pixel_values=torch.from_numpy(images).to(device),
                input_points=middle,
                input_labels=torch.ones((len(images), 1, 1), dtype=torch.int32, device=device),
                multimask_output=False,
            )
        return found.pred_masks[:, 0, 0].cpu().numpy()

    return masks


def _size(path: Path) -> tuple[int, int]:
    """Return the shorter and longer side, pixels, at which Grounding DINO sees an image."""
    try:
        size = json.loads(path.read_text("utf-8")).get("size", {})
        return int(size.get("shortest_edge", _SIZE[0])), int(size.get("longest_edge", _SIZE[1]))
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise DataError("the file is not the configuration of an image processor", where=str(path)) from error


VARIABLE = "ORTHOCAPTURE_GROUNDED"
BOXES, MASKS = "grounding-dino", "sam2"  # the two folders
_FILES = {
    BOXES: ("config.json", "preprocessor_config.json", "model.safetensors", "tokenizer.json"),
    MASKS: ("config.json", "model.safetensors"),
}
_NAMES = tuple(f"{model}/{name}" for model, names in _FILES.items() for name in names)
_SOURCES = {BOXES: "IDEA-Research/grounding-dino-base", MASKS: "facebook/sam2.1-hiera-large"}
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Weights:
    """A folder with `grounding-dino/` and `sam2/`, each as Hugging Face publishes the model."""

    folder: Path

    @property
    def boxes(self) -> Path:
        """The folder of Grounding DINO."""
        return self.folder / BOXES

    @property
    def masks(self) -> Path:
        """The folder of SAM 2."""
        return self.folder / MASKS

    def sha256(self) -> Mapping[str, str]:
        """Return the hash of every file that decides what the networks find, by its name within the folder."""
        return {name: _sha256(self.folder / name) for name in _NAMES}


def weights_in(folder: Path | None = None) -> Weights:
    """Return the weights in a folder; None: in the one that the environment variable ORTHOCAPTURE_GROUNDED names.

    Raises:
        ConfigurationError: no folder is named, or files are missing; the remedy says which, and where to put them.
    """
    named = folder or (Path(value) if (value := os.environ.get(VARIABLE)) else None)
    if named is None:
        raise ConfigurationError(
            "the detector `grounded` needs the weights of Grounding DINO and SAM 2",
            where=VARIABLE,
            remedy=f"Set {VARIABLE} (or --weights) to a folder with {_wanted()}",
        )
    missing = [name for name in _NAMES if not (named / name).is_file()]
    if missing:
        raise ConfigurationError(
            f"weights are missing: {', '.join(missing)}", where=str(named), remedy=f"The folder needs {_wanted()}"
        )
    return Weights(named)


def _wanted() -> str:
    return "; ".join(
        f"{model}/ with {', '.join(names)} of {_SOURCES[model]} (huggingface.co)" for model, names in _FILES.items()
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
