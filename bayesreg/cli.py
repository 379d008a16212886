"""Define the command line. The commands import large modules themselves, so that help appears at once."""

import errno
import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from bayesreg import __version__
from bayesreg.command_options import (
    Around,
    Channel,
    ConfigFile,
    Draws,
    Far,
    FixedIgnore,
    FixedImage,
    FolderOfRun,
    FoldersOfRuns,
    ImageFile,
    Inverse,
    LabelFile,
    LabelsFile,
    LandmarksFiles,
    Like,
    MapsLike,
    Margin,
    Mask,
    MeasuredSurfaceFiles,
    MovingIgnore,
    MovingImage,
    OutFolder,
    Overrides,
    PointsFile,
    QuickLook,
    Resume,
    Space,
    SurfaceFile,
    Table,
)
from bayesreg.compilation import compile_quickly, keep_compiled_programs
from bayesreg.messages import show_messages

NOT_CONVERGED = 3
STORAGE_FAILURES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO)


class _Commands(TyperGroup):
    """The group of commands, which converts expected exceptions into a message and an exit status.

    The status is 2 for an error of the user, 1 for a failing disk, and 128 plus its number for a signal. Any other
    exception is a bug.
    """

    def invoke(self, ctx: Any) -> Any:
        from bayesreg.workflow.interruption import Interrupted, ending_at_once

        try:
            with ending_at_once(), show_messages():
                return super().invoke(ctx)
        except Interrupted as signal:
            typer.echo(f"bayesreg: {signal}; a run goes on from its last whole block of draws with --resume", err=True)
            raise typer.Exit(signal.status) from None
        except ValueError as error:
            from bayesreg.types import InputError

            if not isinstance(error, InputError):
                raise
            typer.echo(f"bayesreg: {error}", err=True)
            raise typer.Exit(2) from None
        except OSError as error:
            if error.errno not in STORAGE_FAILURES:
                raise
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO)
            advice = "; what was stored before is kept, and a run goes on with --resume" if full else ""
            typer.echo(f"bayesreg: {error}{advice}", err=True)
            raise typer.Exit(1) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Status: 0 done, 2 bad input, 3 not converged (results are written), 130 and 143 stopped by Ctrl-C and "
    "SIGTERM (a run goes on with --resume), 1 anything else.",
)


def _quieten(wanted: bool) -> bool:
    if wanted:
        # The block of `show_messages` around the command restores the level.
        logging.getLogger("bayesreg").setLevel(logging.WARNING)
    return wanted


Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Show no progress, and of messages warnings alone.", callback=_quieten)
]
Page = Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="HTML file to write.")]


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"bayesreg {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    """Registration of two images with posterior distributions of displacement and stiffness."""
    compile_quickly()
    keep_compiled_programs()


@app.command()
def run(
    config: ConfigFile, out: OutFolder, overrides: Overrides = None, resume: Resume = False, quiet: Quiet = False
) -> None:
    """Sample the posterior; write draws, images and a report."""
    from bayesreg.config import load_config

    _sample(load_config(config, overrides or ()), out, resume, quiet)


@app.command()
def register(
    out: OutFolder,
    fixed: FixedImage = None,
    moving: MovingImage = None,
    labels: LabelFile = None,
    table: Table = None,
    intracranial: Mask = None,
    fixed_ignore: FixedIgnore = None,
    moving_ignore: MovingIgnore = None,
    channel: Channel = None,
    landmarks: LandmarksFiles = None,
    surface: MeasuredSurfaceFiles = None,
    quick: QuickLook = False,
    overrides: Overrides = None,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Sample the posterior of images or points in files; DIR/config.yaml holds the configuration."""
    from bayesreg.workflow.register import understand

    understood = understand(
        fixed,
        moving,
        labels,
        table,
        intracranial,
        fixed_ignore,
        moving_ignore,
        channel or (),
        overrides or (),
        quick,
        landmarks or (),
        surface or (),
    )
    typer.echo("\n".join(understood.lines))
    _sample(understood.config, out, resume, quiet)


@app.command()
def check(config: ConfigFile, overrides: Overrides = None) -> None:
    """Do everything but sampling; estimate time and memory."""
    from bayesreg.config import load_config

    settings = load_config(config, overrides or ())
    from bayesreg.workflow.check import check

    typer.echo(check(settings).cost)


@app.command()
def simulate(config: ConfigFile, out: OutFolder, overrides: Overrides = None) -> None:
    """Make the synthetic pair of a configuration, with its truth."""
    from bayesreg.config import load_config

    settings = load_config(config, overrides or ())
    from bayesreg.workflow.simulate import simulate

    simulate(settings, out)
    typer.echo(f"Pair: {out}")


@app.command()
def apply(
    folder: FolderOfRun,
    out: OutFolder,
    points: PointsFile = None,
    image: ImageFile = None,
    labels: LabelsFile = None,
    mesh: SurfaceFile = None,
    inverse: Inverse = False,
    around: Around = "harmonic",
    like: Like = None,
    far: Far = None,
    draws: Draws = None,
    space: Space = None,
    margin: Margin = None,
    quiet: Quiet = False,
) -> None:
    """Carry points, surfaces, images or labels from the world of FIXED to that of MOVING, with what is unsure of it."""
    from bayesreg.results.apply import apply

    written = apply(
        folder,
        out,
        points=points,
        image=image,
        labels=labels,
        mesh=mesh,
        inverse=inverse,
        around=around,
        like=like,
        far=far or (2.0,),
        draws=draws,
        space=space,
        margins=margin or (),
    )
    typer.echo("\n".join(f"Written: {path}" for path in written))


@app.command()
def maps(folder: FolderOfRun, out: OutFolder, far: Far = None, like: MapsLike = None, quiet: Quiet = False) -> None:
    """Write maps of a run: how sure every point is, how volume changes, how stiff the tissue is."""
    from bayesreg.results.maps import maps

    written = maps(folder, out, far=far or (2.0,), like=like)
    typer.echo("\n".join(f"Written: {path}" for path in written))


@app.command()
def slicer(folder: FolderOfRun, out: OutFolder) -> None:
    """Write a run as a scene of 3D Slicer, in the world of MOVING."""
    from bayesreg.results.slicer import slicer

    typer.echo(f"Scene: {slicer(folder, out)}")


@app.command()
def reproduce(folder: FolderOfRun, out: OutFolder, quiet: Quiet = False) -> None:
    """Run again what a run's folder holds, and tell whether the draws are the same, bit for bit."""
    from bayesreg.workflow.reproduce import reproduce

    comparison = reproduce(folder, out, progress=not quiet)
    typer.echo("\n".join(comparison.lines))
    if not comparison.same:
        raise typer.Exit(1)


@app.command()
def serve(
    config: Annotated[Path, typer.Argument(metavar="CONFIG|DIR", help="Configuration, or the folder of a run.")],
    port: Annotated[int, typer.Option(help="On loopback.", min=1, max=65_535)] = 4242,
) -> None:
    """Offer log posterior, gradient and forward model to clients of UM-Bridge on this machine."""
    from bayesreg.workflow.serve import serve

    serve(config, port)


@app.command()
def batch(
    cohort: Annotated[Path, typer.Argument(metavar="COHORT", help="Subjects and what they share, a YAML file.")],
    out: OutFolder,
    scheduler: Annotated[str | None, typer.Option(metavar="TCP", help="A Dask scheduler that exists, tcp://…")] = None,
    quiet: Quiet = False,
) -> None:
    """Run all subjects of a cohort, several at a time; those that have ended are left, others go on."""
    from bayesreg.workflow.batch import batch
    from bayesreg.workflow.interruption import Interrupted

    try:
        table = batch(cohort, out, scheduler, progress=not quiet)
    except Interrupted as signal:
        typer.echo(f"bayesreg: {signal}; the same command goes on where each run stands", err=True)
        raise typer.Exit(signal.status) from None
    failed = int((table["state"] == "failed").sum())
    typer.echo(f"{len(table) - failed} of {len(table)} runs have finished: {out / 'cohort.html'}")
    if failed:
        raise typer.Exit(1)


@app.command()
def report(folder: FolderOfRun) -> None:
    """Write the report of a run once more."""
    from bayesreg.workflow.reports import report

    typer.echo(f"Report: {report(folder)}")


@app.command()
def compare(folders: FoldersOfRuns, out: Page = Path("compare.html")) -> None:
    """Put runs side by side, as the paper does with three tissues and one."""
    if len(folders) < 2:
        raise typer.BadParameter("expected the folders of at least two runs", param_hint="DIR DIR...")
    from bayesreg.workflow.reports import compare

    typer.echo(f"Comparison: {compare(folders, out)}")


@app.command()
def schema() -> None:
    """Print the JSON schema of a configuration, for editors."""
    import json

    from bayesreg.config import schema

    typer.echo(json.dumps(schema(), indent=2))


def main() -> None:
    """Run the `bayesreg` command; this is its entry point."""
    from bayesreg.ahead import works_still

    try:
        app()
    except SystemExit as ended:
        if works_still():
            # Python would wait for it, though the command needs it no more.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(ended.code or 0))
        raise


def _sample(config: Any, out: Path, resume: bool, quiet: bool) -> None:
    """Run a configuration, print the path of the report, and exit with `NOT_CONVERGED` if it has not converged."""
    from bayesreg.workflow.run import run

    result = run(config, out, resume=resume, progress=not quiet)
    typer.echo(f"Report: {Path(result.folder) / 'report.html'}")
    if result.converged is False:
        typer.echo("Not converged; the results are written, and the report says how far it came.")
        raise typer.Exit(NOT_CONVERGED)
