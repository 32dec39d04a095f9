"""The public names of scenemi, and what importing it must not load."""

from __future__ import annotations

import subprocess
import sys

import scenemi


def test_public_names_exist_and_are_the_expected_ones() -> None:
    assert set(scenemi.__all__) >= {
        "InbetweeningPrior", "InterpolationPrior", "KeyframeMotion", "KeyframeWindow", "WindowMotion",
        "inbetween", "load_prior", "plan_windows", "select_keyframes", "solve_motions",
    }  # fmt: skip
    assert all(hasattr(scenemi, name) for name in scenemi.__all__)


def test_import_needs_neither_torch_nor_the_pipeline() -> None:
    code = (
        "import sys, scenemi; bad = [m for m in ('torch', 'open3d', 'stages', 'video2anim.pipeline',"
        " 'video2anim.networks', 'video2anim.artifacts') if m in sys.modules]; sys.exit(','.join(bad) or 0)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
