"""Register a pair of `studies.external.make_pair` with a peer of bayesreg.

    python -m studies.external.peers {Demons,B-spline,SyN} PAIR -o OUT

OUT/displacement_mean.nii.gz is then an ITK displacement field on the grid of the fixed image: mm, LPS, fixed to moving.
Every peer gets the inputs of a good user: images without their shading (N4), and the mask of the inside of the skull.
If pair.json says that the moving image is misaligned, B-splines and SyN have a rigid stage (SyN also has an affine
one). If the contrasts differ, they compare by mutual information. A cavity is outside the mask of the moving image.
Demons have no such options, and do not run on such pairs.
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

# A peer takes the folder of the pair, and writes the file of the field.
Peer = Callable[[Path, Path], None]


def without_shading(pair: Path, out: Path) -> None:
    """Write both images of a pair, divided by their bias fields (N4 on voxels of 4 mm), and its mask."""
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


class PairFacts(NamedTuple):
    """The facts that a user knows of a pair."""

    misaligned: bool
    same_contrast: bool
    # The mask of the moving image, if there is a cavity.
    mask: Path | None

    @classmethod
    def of(cls, pair: Path) -> PairFacts:
        facts, mask = json.loads((pair / "pair.json").read_text()), pair / "outside_cavity.nii.gz"
        return cls(facts.get("rigid", 0) > 0, facts.get("contrast", "t1") == "t1", mask if mask.exists() else None)


def demons(pair: Path, field: Path) -> None:
    """Register by the diffeomorphic Demons of SimpleITK on three levels.

    The field is smoothed by 1.5 voxels after each iteration. The histogram of the moving image is first matched to that
    of the fixed one, because Demons compare intensities. Demons use no mask; on images without the skull and the scalp
    their error was greater.
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
    """Smooth an image of voxels of 1 mm, and keep every `factor`-th voxel."""
    import SimpleITK

    if factor == 1:
        return image
    return SimpleITK.Shrink(SimpleITK.SmoothingRecursiveGaussian(image, factor / 2), [factor] * 3)


def b_spline(pair: Path, field: Path) -> None:
    """Register by the cubic B-splines of elastix, by normalised correlation in the mask.

    There are 16 mm between control points, on four levels. The other settings are elastix's defaults, with adaptive
    stochastic gradient descent, except for twice the iterations (500) and five times the samples (10,000).
    """
    import itk

    fixed, moving = (itk.imread(str(pair / f"{name}.nii.gz"), itk.F) for name in ("fixed", "moving"))
    inside = itk.imread(str(pair / "intracranial.nii.gz"), itk.UC)
    parameters, facts = itk.ParameterObject.New(), PairFacts.of(pair)
    if facts.misaligned:
        parameters.AddParameterMap(parameters.GetDefaultParameterMap("rigid", 4))
    masks = {} if facts.mask is None else {"moving_mask": itk.imread(str(facts.mask), itk.UC)}
    settings = dict(parameters.GetDefaultParameterMap("bspline", 4, 16.0)) | {
        "Registration": ["MultiResolutionRegistration"],
        "Metric": ["AdvancedNormalizedCorrelation" if facts.same_contrast else "AdvancedMattesMutualInformation"],
        "GridSpacingSchedule": ["8", "4", "2", "1"],
        "Interpolator": ["BSplineInterpolator"],
        "NumberOfSpatialSamples": ["10000"],
        "MaximumNumberOfIterations": ["500"],
        "WriteResultImage": ["false"],
    }
    parameters.AddParameterMap(settings)
    _, transform = itk.elastix_registration_method(
        fixed, moving, parameter_object=parameters, fixed_mask=inside, number_of_threads=THREADS, **masks
    )
    # transformix also writes its own file, by default into the current folder.
    u = itk.transformix_deformation_field(moving, transform, output_directory=str(pair))
    itk.imwrite(u, str(field))


def syn(pair: Path, field: Path) -> None:
    """Register by SyN of ANTs with the settings of antsRegistrationSyNQuick.sh: mutual information in the mask.

    If the images are aligned, the rigid and the affine stage are left out.
    """
    import ants

    fixed, moving, inside = (
        ants.image_read(str(pair / f"{name}.nii.gz")) for name in ("fixed", "moving", "intracranial")
    )
    facts = PairFacts.of(pair)
    masks = {"mask": inside} | ({} if facts.mask is None else {"moving_mask": ants.image_read(str(facts.mask))})
    stages = {} if facts.misaligned else {"initial_transform": "Identity"}
    kind = "antsRegistrationSyNQuick[s]" if facts.misaligned else "antsRegistrationSyNQuick[so]"
    registration = ants.registration(fixed, moving, type_of_transform=kind, **masks, **stages)
    composed = ants.apply_transforms(
        fixed, moving, registration["fwdtransforms"], compose=str(field.with_suffix("")) + "_"
    )
    shutil.move(composed, field)


PEERS: dict[str, Peer] = {"Demons": demons, "B-spline": b_spline, "SyN": syn}


def main() -> None:
    """Read the command line, and register a pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("pair", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as prepared:
        without_shading(arguments.pair, Path(prepared))
        PEERS[arguments.peer](Path(prepared), arguments.out / FIELD)


if __name__ == "__main__":
    main()
