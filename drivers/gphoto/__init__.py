"""Driver for still cameras through libgphoto2, over USB or PTP/IP; written for the Sony Alpha 7R V."""

from __future__ import annotations

from drivers.gphoto.camera import GphotoCamera, GphotoConfig
from drivers.plugin import DriverSpec

__all__ = ["DRIVER", "GphotoCamera", "GphotoConfig"]

DRIVER = DriverSpec(kind="camera", config=GphotoConfig, build=GphotoCamera, hosted=True, call_timeout_s=120.0)
