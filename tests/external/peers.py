"""Register a pair of `tests.external.make_pair` by a peer of bayesreg.

    python -m tests.external.peers {Demons,B-spline,SyN} PAIR -o OUT

OUT/displacement_mean.nii.gz is then an ITK displacement field on the grid of the fixed image: mm, LPS, fixed to moving.
The pairs are aligned and of one contrast, but for a slow shading; skull and scalp stay where they are. Every peer is
given what a good user begins with: images without their shading (N4), and the mask of the inside of the skull.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

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
        n4.Execute(SimpleITK.Shrink(image, [4] * 3), SimpleITK.Shrink(inside, [4] * 3))
        shading = SimpleITK.Exp(n4.GetLogBiasFieldAsImage(image))
        SimpleITK.WriteImage(image / SimpleITK.Cast(shading, image.GetPixelID()), str(out / f"{name}.nii.gz"))
    shutil.copy(pair / "intracranial.nii.gz", out)


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
    parameters = itk.ParameterObject.New()
    settings = dict(parameters.GetDefaultParameterMap("bspline", 4, 16.0)) | {
        "Registration": ["MultiResolutionRegistration"],
        "Metric": ["AdvancedNormalizedCorrelation"],
        "GridSpacingSchedule": ["8", "4", "2", "1"],
        "Interpolator": ["BSplineInterpolator"],
        "NumberOfSpatialSamples": ["10000"],
        "MaximumNumberOfIterations": ["500"],
        "WriteResultImage": ["false"],
    }
    parameters.AddParameterMap(settings)
    _, found = itk.elastix_registration_method(
        fixed, moving, parameter_object=parameters, fixed_mask=inside, number_of_threads=THREADS
    )
    # It also writes a field of its own, by default into the current folder.
    u = itk.transformix_deformation_field(moving, found, output_directory=str(pair))
    itk.imwrite(u, str(field))


def syn(pair: Path, field: Path) -> None:
    """SyN of ANTs as antsRegistrationSyNQuick.sh calls it, without a rigid and an affine stage, in the mask."""
    import ants

    fixed, moving, inside = (
        ants.image_read(str(pair / f"{name}.nii.gz")) for name in ("fixed", "moving", "intracranial")
    )
    found = ants.registration(
        fixed,
        moving,
        type_of_transform="antsRegistrationSyNQuick[so]",
        initial_transform="Identity",
        mask=inside,
    )
    shutil.copy(next(path for path in found["fwdtransforms"] if path.endswith("Warp.nii.gz")), field)


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
