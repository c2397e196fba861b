"""The local folder with the weights of Grounding DINO and SAM 2, and the hashes that identify them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from service.core.errors import ConfigurationError

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
        """The hash of every file that decides what the networks find, by its name within the folder."""
        return {name: _sha256(self.folder / name) for name in _NAMES}


def weights_in(folder: Path | None = None) -> Weights:
    """The weights in a folder; None: in the one that the environment variable ORTHOCAPTURE_GROUNDED names.

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
