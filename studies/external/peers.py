"""Register a pair of `studies.external.make_pair` by a peer of bayesreg.

    python -m studies.external.peers {Demons,B-spline,SyN} PAIR -o OUT

OUT/displacement_mean.nii.gz is then an ITK displacement field on the grid of the fixed image: mm, LPS, fixed to moving.
Every peer is given what a good user begins with: images without their shading (N4), and the mask of the inside of the
skull. Where pair.json says that the moving image is misaligned, B-splines and SyN have a rigid stage of their own (SyN
an affine one after it); where it is of another contrast, they compare by mutual information; and a cavity is outside of
the mask of the moving image. Demons know none of these, and are not run there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

FIELD = "displacement_mean.nii.gz"
THREADS = 2

# (folder of the pair, file of the field) → None
Peer = Callable[[Path, Path], None]


def without_shading(pair: Path, out: Path) -> None:
    """Write both images of a pair, divided by their bias fields (N4 on one voxel of 4 × 4 × 4), and its mask."""
    import SimpleITK

    inside = SimpleITK.ReadImage(str(pair / "intracranial.nii.gz"), SimpleITK.sitkUInt8)
    for name in ("fixed", "moving"):
        image = SimpleITK.ReadImage(str(pair / f"{name}.nii.gz"), SimpleITK.sitkFloat32)
        n4 = SimpleITK.N4BiasFieldCorrectionImageFilter()
        thin = [max(1, round(4 / size)) for size in image.GetSpacing()]
        same = image.GetSize() == inside.GetSize() and np.allclose(image.GetDirection(), inside.GetDirection())
        mask = [SimpleITK.Shrink(inside, thin)] if same else []
        n4.Execute(SimpleITK.Shrink(image, thin), *mask)
        shading = SimpleITK.Exp(n4.GetLogBiasFieldAsImage(image))
        SimpleITK.WriteImage(image / SimpleITK.Cast(shading, image.GetPixelID()), str(out / f"{name}.nii.gz"))
    for name in ("intracranial.nii.gz", "pair.json"):
        shutil.copy(pair / name, out)
    if (pair / "cavity.nii.gz").exists():
        cavity = SimpleITK.ReadImage(str(pair / "cavity.nii.gz"), SimpleITK.sitkUInt8)
        SimpleITK.WriteImage(cavity == 0, str(out / "outside_cavity.nii.gz"))


class Known(NamedTuple):
    """What a user knows of a pair."""

    misaligned: bool
    one_contrast: bool
    # Of the moving image, where there is a cavity.
    mask: Path | None

    @classmethod
    def of(cls, pair: Path) -> Known:
        facts, mask = json.loads((pair / "pair.json").read_text()), pair / "outside_cavity.nii.gz"
        return cls(facts.get("rigid", 0) > 0, facts.get("contrast", "t1") == "t1", mask if mask.exists() else None)


def demons(pair: Path, field: Path) -> None:
    """Diffeomorphic Demons of SimpleITK on three levels, the field smoothed by 1.5 voxels after each iteration.

    The histogram of the moving image is first matched to that of the fixed one, since Demons compare intensities. They
    know no mask; on images without the skull and what is outside of it the error was greater.
    """
    import SimpleITK

    fixed, moving = (
        SimpleITK.ReadImage(str(pair / f"{name}.nii.gz"), SimpleITK.sitkFloat32) for name in ("fixed", "moving")
    )
    moving = SimpleITK.HistogramMatching(moving, fixed, 256, 15, True)
    u = None
    for factor, iterations in ((4, 200), (2, 100), (1, 50)):
        level = [_coarser(image, factor) for image in (fixed, moving)]
        method = SimpleITK.DiffeomorphicDemonsRegistrationFilter()
        method.SetNumberOfIterations(iterations)
        method.SetSmoothDisplacementField(True)
        method.SetStandardDeviations(1.5)
        u = method.Execute(*level) if u is None else method.Execute(*level, SimpleITK.Resample(u, level[0]))
    SimpleITK.WriteImage(SimpleITK.Cast(u, SimpleITK.sitkVectorFloat32), str(field))


def _coarser(image: SimpleITK.Image, factor: int) -> SimpleITK.Image:
    """Every so many voxels of the smoothed image, mm being voxels here."""
    import SimpleITK

    if factor == 1:
        return image
    return SimpleITK.Shrink(SimpleITK.SmoothingRecursiveGaussian(image, factor / 2), [factor] * 3)


def b_spline(pair: Path, field: Path) -> None:
    """Cubic B-splines of elastix, 16 mm between control points, on four levels, by normalised correlation in the mask.

    The rest are elastix's defaults, adaptive stochastic gradient descent among them, but for twice the iterations (500)
    and five times the samples (10,000).
    """
    import itk

    fixed, moving = (itk.imread(str(pair / f"{name}.nii.gz"), itk.F) for name in ("fixed", "moving"))
    inside = itk.imread(str(pair / "intracranial.nii.gz"), itk.UC)
    parameters, known = itk.ParameterObject.New(), Known.of(pair)
    if known.misaligned:
        parameters.AddParameterMap(parameters.GetDefaultParameterMap("rigid", 4))
    masks = {} if known.mask is None else {"moving_mask": itk.imread(str(known.mask), itk.UC)}
    settings = dict(parameters.GetDefaultParameterMap("bspline", 4, 16.0)) | {
        "Registration": ["MultiResolutionRegistration"],
        "Metric": ["AdvancedNormalizedCorrelation" if known.one_contrast else "AdvancedMattesMutualInformation"],
        "GridSpacingSchedule": ["8", "4", "2", "1"],
        "Interpolator": ["BSplineInterpolator"],
        "NumberOfSpatialSamples": ["10000"],
        "MaximumNumberOfIterations": ["500"],
        "WriteResultImage": ["false"],
    }
    parameters.AddParameterMap(settings)
    _, found = itk.elastix_registration_method(
        fixed, moving, parameter_object=parameters, fixed_mask=inside, number_of_threads=THREADS, **masks
    )
    # It also writes a field of its own, by default into the current folder.
    u = itk.transformix_deformation_field(moving, found, output_directory=str(pair))
    itk.imwrite(u, str(field))


def syn(pair: Path, field: Path) -> None:
    """SyN of ANTs as antsRegistrationSyNQuick.sh calls it, which compares by mutual information, in the mask.

    Without its rigid and its affine stage where the images are aligned.
    """
    import ants

    fixed, moving, inside = (
        ants.image_read(str(pair / f"{name}.nii.gz")) for name in ("fixed", "moving", "intracranial")
    )
    known = Known.of(pair)
    masks = {"mask": inside} | ({} if known.mask is None else {"moving_mask": ants.image_read(str(known.mask))})
    stages = {} if known.misaligned else {"initial_transform": "Identity"}
    kind = "antsRegistrationSyNQuick[s]" if known.misaligned else "antsRegistrationSyNQuick[so]"
    found = ants.registration(fixed, moving, type_of_transform=kind, **masks, **stages)
    whole = ants.apply_transforms(fixed, moving, found["fwdtransforms"], compose=str(field.with_suffix("")) + "_")
    shutil.move(whole, field)


PEERS: dict[str, Peer] = {"Demons": demons, "B-spline": b_spline, "SyN": syn}


def main() -> None:
    """Register a pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("pair", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as prepared:
        without_shading(given.pair, Path(prepared))
        PEERS[given.peer](Path(prepared), given.out / FIELD)


if __name__ == "__main__":
    main()
