"""Export of a run under the names of BIDS derivatives, each file with a sidecar."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from bayesreg import __version__
from bayesreg.config.sections import BidsConfig
from bayesreg.io.atomic import write_json
from bayesreg.io.run_folder import Place
from bayesreg.results.displacement_fields import MEAN, MEAN_INVERSE

FOLDER = "bids"


def write_bids(folder: Path, names: BidsConfig, place: Place) -> None:
    """Write a derivative dataset, bids/, into the folder of a run; files are hard links if the file system allows it.

    Parameters
    ----------
    folder : path
        The folder of a finished run.
    names : BidsConfig
        Subject, session, and the names of the spaces of both images.
    place : callable
        The callable from `bayesreg.io.run_folder.RunFolder.writing`.

    Notes
    -----
    A transform from-A_to-B resamples an image of A on the grid of B, as BIDS defines it for mode-image.
    """
    entities = f"sub-{names.subject}" + ("" if names.session is None else f"_ses-{names.session}")
    within = f"{FOLDER}/{entities.replace('_', '/')}/anat"
    forward, backward = (
        f"from-{a}_to-{b}_mode-image" for a, b in ((names.moving, names.fixed), (names.fixed, names.moving))
    )
    units, space = {"Units": "mm"}, f"space-{names.fixed}"
    files = {
        MEAN: (f"{forward}_xfm.h5", "Posterior mean transform, ITK composite: a displacement field, then a pose.", {}),
        MEAN_INVERSE: (f"{backward}_xfm.h5", "Its inverse.", {}),
        "warped_mean.nii.gz": (f"{space}_desc-warped_{names.suffix}.nii.gz", "Resampled by the posterior mean.", {}),
        "displacement_mean.nii.gz": (
            f"{space}_stat-mean_displacement.nii.gz", "Posterior mean displacement, vectors in LPS.", units,
        ),
        "displacement_sd.nii.gz": (
            f"{space}_stat-sd_displacement.nii.gz", "Posterior standard deviation by component.", units,
        ),
    }  # fmt: skip
    for source, (name, description, more) in files.items():
        if not (folder / source).is_file():
            continue
        target = f"{within}/{entities}_{name}"
        _link(folder / source, place(target))
        sidecar = target.removesuffix(".gz").rpartition(".")[0] + ".json"
        write_json(place(sidecar), {"Description": description, **more})
    generated = [{"Name": "bayesreg", "Version": __version__}]
    write_json(
        place(f"{FOLDER}/dataset_description.json"),
        {"Name": "bayesreg", "BIDSVersion": "1.10.0", "DatasetType": "derivative", "GeneratedBy": generated},
    )


def _link(source: Path, target: Path) -> None:
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
