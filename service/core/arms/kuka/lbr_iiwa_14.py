"""The KUKA LBR iiwa 14 R820."""

from __future__ import annotations

from service.core.arms.kuka.family import lbr_r820

ARM = lbr_r820("LBR iiwa 14")
