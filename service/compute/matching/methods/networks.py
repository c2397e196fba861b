"""PyTorch and kornia, which learned methods need: imported only when such a method is used."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol as Interface

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.matching.methods.method import Picture
from service.core.errors import ConfigurationError, DataError

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
