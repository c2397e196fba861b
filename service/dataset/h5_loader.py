"""Loads an exported data set; needs numpy and h5py alone. PyTorch's DataLoader takes a `Views` as its data set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np


class Views:
    """The views of a split, each a dictionary of arrays: image, depth_m, normal, valid, markers, K, distortion,
    T_world_camera, covariance, and its name.

    Frames and units are in the attributes of `data.h5`: metres, pixel centres at integers, depth along z.
    """

    def __init__(self, folder: str | Path, split: str = "dense") -> None:
        """Open the folder that holds data.h5; `split` is dense, sparse, train or test."""
        self._path = Path(folder) / "data.h5"
        with h5py.File(self._path, "r") as file:
            self.simulated = bool(file.attrs["simulated"])
            self.names = [name.decode() for name in np.asarray(file[f"splits/{split}"])]
            mesh: Any = file["mesh"]
            self.mesh = (np.asarray(mesh["vertices_m"]), np.asarray(mesh["faces"]))
            # Of each vertex, if CT and scan were fused: 0: CT, 1: scan, 2: blend; sigma along its normal.
            self.mesh_source = np.asarray(mesh["source"]) if "source" in mesh else None
            self.mesh_sigma_m = np.asarray(mesh["sigma_m"]) if "sigma_m" in mesh else None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> dict[str, Any]:
        # Opened at each call: the worker processes of a loader must not share an open file.
        with h5py.File(self._path, "r") as file:
            view: Any = file[f"views/{self.names[index]}"]
            arrays = {name: np.asarray(view[name]) for name in view}
        return {"name": self.names[index], **arrays}
