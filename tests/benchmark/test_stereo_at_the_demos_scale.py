"""The stereo method on as many photographs as the demonstration takes, as large, of the same scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.benchmark.methods import methods
from service.benchmark.running import Trial, run_trial
from service.compute.surfaces.chamfer import ChamferSettings
from tests.support.scenes.rendered_scene import render_scene
from tests.support.scenes.simulated_data_set import simulated_data_set

SCENE, WIDTH_PX, VIEWS = 7, 1280, 16


@pytest.mark.slow
@pytest.mark.whole
@pytest.mark.timeout(1500)
def test_the_stereo_method_reconstructs_the_specimen_at_the_demos_scale(tmp_path: Path) -> None:
    dataset = simulated_data_set(render_scene(SCENE, WIDTH_PX, VIEWS, cache=tmp_path))
    trial = Trial(methods()["stereo"], "dense", tmp_path, settings=ChamferSettings(spacing_m=3e-4))
    result = run_trial(trial, dataset)
    assert result.score is not None, result.failure
    assert (result.views, result.width) == (VIEWS, WIDTH_PX)
    assert result.score.chamfer_mm < 0.8  # measured: 0.68, of which 0.14 are due to the spacing
    assert result.score.accuracy_mm < 0.35
    assert result.score.seen_percent > 78
    assert result.effort is not None
    assert result.effort.peak_memory_mb < 3000
