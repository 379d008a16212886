"""The sections of a configuration that describe the images: files, datasets, and synthetic pairs made of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StrictBool, ValidationInfo, field_validator

from bayesreg.config.values import ByTissue, Direction, Labels, LabelTable
from bayesreg.label_tables import REST
from bayesreg.settings import FoundFile, FoundImage, NotNegative, Positive, Section
from bayesreg.tissues import BRAIN, ORGAN, PAPER_LAM, PAPER_MU, tissue_names


class Mni152Data(Section):
    """The MNI152 brain that ships with nilearn; a synthetic pair is made of it."""

    source: Literal["mni152"]

    @property
    def tissues(self) -> tuple[str, ...]:
        """The names of the tissues."""
        return BRAIN


class BrainWebData(Section):
    """BrainWeb's label phantom with the T1 of Colin27; a synthetic pair is made of them."""

    source: Literal["brainweb"]
    labels: FoundFile
    """Discrete BrainWeb labels, as they are published."""
    t1: FoundFile
    """T1 image on the same grid."""
    intracranial_labels: Labels = (1, 2, 3, 8)
    """Labels inside the skull; the largest connected part of their union is used."""

    @property
    def tissues(self) -> tuple[str, ...]:
        """The names of the tissues."""
        return BRAIN


class FilesData(Section):
    """The user's own images and labels, from files."""

    source: Literal["files"]
    fixed: FoundImage | None = None
    """Pre-operative image, a file or a DICOM folder; null if only other observations are used."""
    moving: Annotated[FoundImage | None, Field(validate_default=True)] = None
    """Intra-operative image."""
    labels: Annotated[FoundImage | None, Field(validate_default=True)] = None
    """Tissue labels of the fixed image; null takes the tissues of mesh.file, or one tissue for the whole organ."""
    label_names: FoundFile | None = None
    """Lookup table of FreeSurfer, 3D Slicer or ITK-SNAP; label_table may then have names in place of values."""
    label_table: Annotated[LabelTable | None, Field(validate_default=True)] = None
    """Values of the label file by tissue, or ranges of values (1000-1035). The entry background has the values that
    belong to no tissue; the value 0 is the rest of the intracranial mask. Or a name: fast, freesurfer, brainweb, brats,
    brats2023 or mask."""
    intracranial: Annotated[FoundImage | None, Field(validate_default=True)] = None
    """Mask of where the organ may go, with two values or probabilities; without it nothing bounds the motion. Without
    labels this mask is also the organ."""
    fixed_ignore: FoundImage | None = None
    """Mask of the ignored part of the fixed image, such as a tumour; not zero = ignored. On any grid, in its world."""
    moving_ignore: FoundImage | None = None
    """Mask of the ignored part of the moving image, such as a cavity; not zero = ignored. On any grid, in its world."""
    pose: Literal["auto", "fixed", "unknown"] = "auto"
    """auto: if the headers do not align the images, a rigid motion is found first; fixed: the headers are used as they
    are; unknown: the headers say nothing, so that images, pairs of points or a surface are aligned from starts in all
    directions. The rigid part of the displacement is sampled in all cases."""
    pose_sd: tuple[Positive, Positive] = (10.0, 10.0)
    """With pose auto, the sd of the prior of the motion between the headers of two images: mm along each axis for the
    centre of the organ, and degrees about each axis."""
    same_contrast: StrictBool | None = None
    """true: both images have one contrast and one scale of intensities; false: the fixed image is compared through a
    map of its intensities; null: the program decides from the images."""

    @property
    def tissues(self) -> tuple[str, ...] | None:
        """The names of the tissues; None if only the mesh defines them."""
        if self.label_table is None:
            return (ORGAN,) if self.fixed is not None else None
        return tissue_names(self.label_table)

    @field_validator("moving")
    @classmethod
    def _is_a_pair(cls, moving: Path | None, info: ValidationInfo) -> Path | None:
        if "fixed" in info.data and (moving is None) != (info.data["fixed"] is None):
            raise ValueError("a pair of images needs both, fixed and moving")
        return moving

    @field_validator("intracranial")
    @classmethod
    def _bounds_the_rest(cls, mask: Path | None, info: ValidationInfo) -> Path | None:
        table = info.data.get("label_table") or {}
        if mask is None and (rest := [name for name in tissue_names(table) if REST in table[name]]):
            raise ValueError(
                f"label_table has {rest[0]} as the label 0: what no label names inside the mask of the organ; expected "
                "that mask, such as what is not zero in an image without a skull"
            )
        return mask

    @field_validator("fixed_ignore", "moving_ignore")
    @classmethod
    def _has_an_image(cls, ignore: Path | None, info: ValidationInfo) -> Path | None:
        if ignore is not None and "fixed" in info.data and info.data["fixed"] is None:
            raise ValueError("there is no image of which a part could be ignored; expected null")
        return ignore

    @field_validator("label_table")
    @classmethod
    def _belongs_to_labels(cls, table: LabelTable | None, info: ValidationInfo) -> LabelTable | None:
        if "labels" in info.data and (table is None) != (info.data["labels"] is None):
            raise ValueError("labels and label_table belong together; expected both, or neither")
        return table


class Scan(Section):
    """Options of the two scans, as from a hospital, that are stored beside a synthetic pair."""

    millimetres: NotNegative = 8.0
    """Translation of the organ between the scans, mm."""
    degrees: NotNegative = 8.0
    """Rotation of the organ between the scans, degrees."""
    inverted: StrictBool = False
    """Whether the intensities in the organ are inverted (dark and bright), as between T1 and T2."""
    cavity: NotNegative = 0.0
    """Radius of a cavity where the surface moves most, mm; 0: no cavity."""


class _Pair(Section):
    displacement: Positive = 15.0
    """Displacement of the patch towards the centre of gravity, mm."""
    patch_nodes: Annotated[int, Field(strict=True, ge=3)] = 20
    """Number of boundary nodes in the patch."""
    direction: Direction | None = None
    """Direction from the centre of gravity to the patch, world RAS; null: the first of several without inversions."""
    lam: ByTissue = Field(default=dict(PAPER_LAM))
    """True first Lamé parameter of every tissue."""
    mu: ByTissue = Field(default=dict(PAPER_MU))
    """True second Lamé parameter of every tissue."""
    smoothing_mm: NotNegative | None = None
    """Standard deviation of the Gaussian that smooths the anatomy first, mm; null: the default of the kind of pair."""
    scan: Scan | None = None
    """Options of the two scans that `bayesreg simulate` also writes under scans/; null writes none."""


class PaperPair(_Pair):
    """A synthetic pair as in section 4.1 of the paper: one mesh for making and registering."""

    kind: Literal["paper"]
    noise_sd: NotNegative = 0.003
    """Noise on each image; intensities run from 0 to 1."""


class CalibratedPair(_Pair):
    """A synthetic pair made on a finer mesh, for checks of coverage."""

    kind: Literal["calibrated"]
    noise_sd: NotNegative = 0.01
    """Noise on each image; intensities run from 0 to 1."""
    making_edge_length: Positive = 10.0
    """Edge length of the mesh on which the pair is made, mm."""
