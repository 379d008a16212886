"""The arguments and options of the command line, each declared once."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from bayesreg.label_tables import TABLES

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, a YAML file.")]
FixedImage = Annotated[
    Path | None,
    typer.Argument(metavar="[FIXED", help="Pre-operative image, a file or a DICOM folder.", show_default=False),
]
MovingImage = Annotated[
    Path | None, typer.Argument(metavar="MOVING]", help="Intra-operative image.", show_default=False)
]
LandmarksFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--landmarks",
        metavar="FILE",
        help="Pairs of points: CSV with fixed_x … moving_z (RAS, mm), or .tag; may be repeated.",
    ),
]
MeasuredSurfaceFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--surface",
        metavar="FILE",
        help="Points on the moved surface of the organ, without partners (.ply, .stl, .vtk, .csv with x, y, z, …); may "
        "be repeated.",
    ),
]
LabelFile = Annotated[
    Path | None,
    typer.Option("--labels", metavar="FILE", help="Tissue labels of FIXED; without them the organ is of one tissue."),
]
Table = Annotated[
    str | None,
    typer.Option(
        "--table",
        metavar="NAME|FILE",
        help=f"Label table: {', '.join(TABLES)}, or a YAML file; recognised if left out.",
    ),
]
Mask = Annotated[Path | None, typer.Option("--intracranial", metavar="FILE", help="Mask of where the organ may go.")]
FixedIgnore = Annotated[
    Path | None, typer.Option("--fixed-ignore", metavar="FILE", help="Mask: not zero where FIXED says nothing.")
]
MovingIgnore = Annotated[
    Path | None,
    typer.Option("--moving-ignore", metavar="FILE", help="Mask: not zero where MOVING says nothing, as in a cavity."),
]
Channel = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="FIXED,MOVING",
        help="Another image of each visit, such as FLAIR beside T1; may be repeated.",
    ),
]
OutFolder = Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the results.")]
FolderOfRun = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")]
FoldersOfRuns = Annotated[list[Path], typer.Argument(metavar="DIR DIR...", help="Folders of two or more runs.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override an entry, e.g. sampler.chains=4; may be repeated."),
]
QuickLook = Annotated[
    bool, typer.Option("--quick", help="Stop at Laplace's approximation, about the mode; the report says approximate.")
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with the run that DIR holds; a finished one needs a larger budget.")
]
PointsFile = Annotated[
    Path | None,
    typer.Option("--points", metavar="FILE", help="Points: CSV with x, y, z (RAS, mm), .fcsv, .mrk.json or .tag."),
]
ImageFile = Annotated[Path | None, typer.Option("--image", metavar="FILE", help="An image.")]
LabelsFile = Annotated[Path | None, typer.Option("--labels", metavar="FILE", help="Labels, carried as probabilities.")]
SurfaceFile = Annotated[
    Path | None,
    typer.Option("--mesh", metavar="FILE", help="A surface or lines: .vtk, .vtp, .vtu, .stl, .ply or .obj."),
]
Inverse = Annotated[bool, typer.Option("--inverse", help="From the world of MOVING to that of FIXED.")]
Around = Annotated[
    Literal["harmonic", "missing"],
    typer.Option("--around", help="Around the mesh the displacement goes on harmonically, or is missing."),
]
Like = Annotated[
    Path | None, typer.Option("--like", metavar="FILE", help="An image on whose grid images and labels are written.")
]
MapsLike = Annotated[
    Path | None,
    typer.Option("--like", metavar="FILE", help="An image of FIXED's world on whose grid maps are written."),
]
Far = Annotated[
    list[float] | None,
    typer.Option("--far", metavar="MM", help="Give P(further off than this); 2 if left out; may be repeated."),
]
Margin = Annotated[
    list[int] | None,
    typer.Option("--margin", metavar="LABEL", help="Write the surface beyond which this one of --labels is improbable "
                 "(below 5 %); may be repeated."),
]  # fmt: skip
Draws = Annotated[int | None, typer.Option(help="How many draws at most; 1,000, for labels 200, if left out.")]
Space = Annotated[
    Literal["RAS", "LPS"] | None,
    typer.Option("--space", help="Of the coordinates of --points and --mesh, where a file does not say."),
]
