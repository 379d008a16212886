"""A run that takes a few seconds: it has a stored mesh, and stops after a fixed number of steps."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

import bayesreg as br
from tests.phantoms import ball_mesh

BAYESREG = (sys.executable, "-c", "from bayesreg.cli import main; main()")
CENTRE = np.array([5.0, -3.0, 8.0])


def write_pair(folder: Path, steps: int = 240) -> Path:
    """Write the files of a pair and a configuration, and return the path of the configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    affine = np.diag([-4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = CENTRE + np.array([50.0, -50.0, -50.0])
    grid = br.Image(np.zeros((26, 26, 26)), affine)
    points = grid.grid_points()
    radius = np.linalg.norm(points - CENTRE, axis=-1)
    labels = np.select([radius < 14, radius < 28, radius < 41], [1, 3, 2], 0)
    noise = np.random.default_rng(0).normal(size=grid.shape)
    fixed = grid.with_voxels(100 + 400 * np.array([0.05, 0.2, 0.5, 0.8])[labels] + 20 * noise * (labels > 0))
    moving = fixed.with_voxels(np.asarray(fixed.interpolate(points + np.array([0.0, 0.8, 0.0]))))
    images = {"fixed": fixed, "moving": moving, "labels": grid.with_voxels(labels.astype(np.int8)),
             "intracranial": grid.with_voxels((radius < 46).astype(np.uint8))}  # fmt: skip
    for name, image in images.items():
        br.save_image(image, folder / f"{name}.nii.gz")
    br.save_mesh(ball_mesh(radius=38), folder / "mesh.vtu")
    config = {
        "seed": 3,
        "data": {"source": "files", **{name: f"{name}.nii.gz" for name in images},
                 "label_table": {"csf": [1], "gm": [2], "wm": [3]}},
        "mesh": {"file": "mesh.vtu"},
        "model": {"preset": "paper"},
        "sampler": {"name": "rwmh", "chains": 2, "thin": 2, "block": 10, "sigma_u": 0.02},
        "stop": {"rhat": None, "ess": None, "max_steps": steps},
        "results": {"draws": 1},
    }  # fmt: skip
    YAML(typ="safe").dump(config, folder / "run.yaml")
    return folder / "run.yaml"


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    """Start the command line in a new process."""
    command = [*BAYESREG, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(*arguments: str | Path) -> tuple[int, str]:
    """Run the command line; return its exit status and its standard error."""
    process = start(*arguments)
    _, error_output = process.communicate()
    return process.returncode, error_output
