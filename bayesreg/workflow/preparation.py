"""Prepare the inputs of a run from its configuration: anatomy, mesh, image pair, and the truth of a synthetic pair."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from itertools import starmap
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.ahead import ahead
from bayesreg.config import Config, resolved_yaml
from bayesreg.config.data import BrainWebData, FilesData
from bayesreg.distance import forbidden
from bayesreg.fem.location import transfer
from bayesreg.ignored import find_filling
from bayesreg.image import Image, robust_scale
from bayesreg.io import store
from bayesreg.io.agreement import require_agreement
from bayesreg.io.datasets import Anatomy, brainweb, from_files, mni152, require_forms_taken, without_labels
from bayesreg.io.displacements import IDENTITY, read_boundary, require_displacement
from bayesreg.io.domain import without_ridges
from bayesreg.io.intensities import in_levels
from bayesreg.io.meshing import domain_labels, load_mesh, mesh_domain
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs
from bayesreg.io.records import Channel, Inputs, Matching, Truth
from bayesreg.io.run_folder import RunFolder
from bayesreg.io.volumes import load_ignored, load_image, load_mask
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.section import Arrays
from bayesreg.model.observations.surface import SurfaceSection
from bayesreg.model.warp import tissue_on_grid
from bayesreg.pose import Pose
from bayesreg.tissues import BRAIN_CLOSING
from bayesreg.types import InputError
from bayesreg.workflow.appraisal import Appraisal, appraise, explain_mesh
from bayesreg.workflow.evaluation import NAME, require_unseen
from bayesreg.workflow.matching import (
    FoundPose,
    MatchedImages,
    MatchedPoints,
    find_image_pose,
    match_channel,
    match_images,
    match_pairs,
    match_surface,
)
from bayesreg.workflow.meshing import complete_lengths, mesh_of, size_of_organ
from bayesreg.workflow.prediction import require_inside
from bayesreg.workflow.simulated_pair import describe_pair, simulate_pair

PROVENANCE = "inputs/provenance.json"

_log = logging.getLogger(__name__)


class Prepared(NamedTuple):
    """The inputs of a run, with the timings and findings of their preparation.

    Attributes
    ----------
    inputs : Inputs
    timings : dict
        Seconds for "anatomy", "images", "mesh" and "pair". The mesh is made beside the images; "mesh" are the seconds
        that it took longer.
    pair : dict
        Properties of a synthetic pair besides its truth; empty for files.
    appraisal : Appraisal or None
        The appraisal of labels and images; None without labels.
    """

    inputs: Inputs
    timings: dict[str, float]
    pair: dict[str, object]
    appraisal: Appraisal | None = None


def prepare(config: Config) -> Prepared:
    """Read or make everything that the posterior needs.

    Raises
    ------
    InputError
        If a file, a label, the mesh or the pair contradicts the configuration.
    """
    clock = _Clock()
    _require_start(config)
    observed = with_held_out({section.name: section.read() for section in config.observations}, config)
    if isinstance(config.data, FilesData) and config.data.labels is None and config.data.fixed is None:
        assert config.mesh.file is not None
        if config.data.pose == "unknown":
            raise InputError("data.pose: unknown needs labels (data.labels), to whose surface the points are aligned")
        mesh = load_mesh(config.mesh.file)
        _require_start(config, mesh)
        clock.lap("mesh")
        boundary, skull = _known_boundary(config, mesh), _skull(config.data.intracranial)
        tissue = _as_stored(tissue_on_grid(mesh))
        inputs = Inputs(resolved_yaml(config), mesh, None, None, tissue, skull, boundary=boundary, observed=observed)
        return Prepared(inputs, clock.laps, {})
    anatomy = _anatomy(config)
    if anatomy.intracranial is not None:
        anatomy = anatomy._replace(intracranial=without_ridges(anatomy.intracranial))
    clock.lap("anatomy")
    scans = _read_scans(config, anatomy)
    if scans is not None and scans.found is not None:
        anatomy = _within_view(anatomy, scans)
    size = size_of_organ(config, anatomy)
    domain = mesh_domain(anatomy.tissue, anatomy.intracranial, size * BRAIN_CLOSING, anatomy.names)
    tissue = _as_stored(domain_labels(anatomy.tissue, domain, anatomy.names))
    settings = complete_lengths(config.mesh, size)
    with ahead(starmap(mesh_of, [(anatomy, domain, settings)])) as meshing:
        matched = None if scans is None else _match(config, scans, domain)
        matched_points = _match_points(config, observed, tissue, anatomy.names)
        appraisal = _appraise(config, anatomy, domain, matched or matched_points)
        clock.lap("images")
    mesh = meshing.result()
    if settings.file is not None:
        require_agreement(mesh, tissue, settings.file)
    appraisal = appraisal._replace(warnings=(*appraisal.warnings, *explain_mesh(mesh, anatomy.tissue)))
    clock.lap("mesh")
    _require_start(config, mesh)
    skull = None if anatomy.intracranial is None else _as_stored(forbidden(anatomy.intracranial))
    if isinstance(config.data, FilesData):
        matching = Matching() if (found := matched or matched_points) is None else found.matching
        boundary = _known_boundary(config, mesh, pose=matching.pose)
        inputs = Inputs(
            resolved_yaml(config), mesh, None, None, tissue, skull, boundary=boundary, observed=observed,
            matching=matching,
        )  # fmt: skip
        if matched is not None:
            inputs = inputs._replace(
                fixed=_as_stored(matched.fixed),
                moving=_as_stored(matched.moving),
                channels=_channels(config, domain, matched),
                fixed_ignore=_mask_as_stored(matched.fixed_ignore),
                moving_ignore=_mask_as_stored(matched.moving_ignore),
            )
        return Prepared(inputs, clock.laps, {}, appraisal)
    assert anatomy.image is not None
    fixed = robust_scale(anatomy.image, domain.voxels != 0)(anatomy.image)
    pair = simulate_pair(config, settings, fixed, anatomy, domain, skull, mesh)
    clock.lap("pair")
    u = pair.u if pair.mesh is mesh else transfer(pair.u, pair.mesh, mesh.points)
    truth = Truth(u, np.asarray(pair.lam), np.asarray(pair.mu))
    images = _as_stored(pair.fixed), _as_stored(pair.moving)
    boundary = _known_boundary(config, mesh, truth)
    inputs = Inputs(resolved_yaml(config), mesh, *images, tissue, skull, truth, boundary, observed)
    return Prepared(inputs, clock.laps, describe_pair(config, pair), appraisal)


def _channels(config: Config, domain: Image, matched: MatchedImages) -> dict[str, Channel]:
    """Match the pairs of images after the first, by their names."""
    assert isinstance(config.data, FilesData)
    channels = {}
    for section in config.pairs_of_images:
        if section.fixed is not None and section.moving is not None:
            images = load_image(section.fixed), load_image(section.moving)
            channel = match_channel(config.data, domain, matched, section.name, *images)
            fixed, moving = _as_stored(channel.fixed), _as_stored(channel.moving)
            channels[section.name] = channel._replace(fixed=fixed, moving=moving)
    return channels


def _ignored(config: Config, which: Literal["fixed", "moving"], image: Image) -> Image | None:
    """Read the mask of the ignored part of an image; None without one."""
    if not isinstance(config.data, FilesData):
        return None
    mask_path, path = getattr(config.data, f"{which}_ignore"), getattr(config.data, which)
    if mask_path is None:
        return None
    mask = load_ignored(mask_path)
    require_forms_taken(image, path, mask, mask_path, (which, f"{which}_ignore"))
    return _as_stored(mask)


class _Scans(NamedTuple):
    """A pair of images from files, with the masks of their ignored voxels, each in its own world.

    Attributes
    ----------
    fixed, moving : Image
    fixed_ignore, moving_ignore : Image or None
    found : FoundPose or None
        The pose, if the organ is what both images show: it is then needed before all else.
    """

    fixed: Image
    moving: Image
    fixed_ignore: Image | None
    moving_ignore: Image | None
    found: FoundPose | None = None


def _read_scans(config: Config, anatomy: Anatomy) -> _Scans | None:
    """Read the pair of images from files; None without such a pair."""
    data = config.data
    if not isinstance(data, FilesData) or data.moving is None or anatomy.image is None:
        return None
    fixed, moving = anatomy.image, load_image(data.moving)
    scans = _Scans(fixed, moving, _ignored(config, "fixed", fixed), _ignored(config, "moving", moving))
    if data.labels is not None or data.intracranial is not None or config.mesh.file is not None:
        return scans
    view = _within_view(anatomy, scans).tissue
    return scans._replace(found=find_image_pose(data, view, *scans[:4]))


def _within_view(anatomy: Anatomy, scans: _Scans) -> Anatomy:
    """Return the part of an organ that the moving image shows, by the pose that was found, or else by the headers.

    Raises
    ------
    InputError
        If it shows nothing of it.
    """
    pose = Pose.identity() if scans.found is None else scans.found.pose
    shown = ~find_filling(scans.moving)
    view = pose.aligned(scans.moving.with_voxels(shown.astype(np.uint8)))
    voxels = np.asarray(anatomy.tissue.voxels)
    parts, count = ndimage.label((voxels != 0) & (view.nearest(anatomy.tissue.grid_points()) != 0))
    if not count:
        raise InputError(
            "the moving image shows nothing of the organ, where the headers place both; check that they show the same "
            "place, or give a mask of the organ (labels) and data.pose: unknown"
        )
    largest = np.bincount(parts.ravel())[1:].argmax() + 1
    if scans.found is not None:
        millilitres = np.count_nonzero(parts == largest) * anatomy.tissue.voxel_volume / 1e3
        _log.warning("the moving image shows %.4g ml of it, which are the organ here", millilitres)
    return anatomy._replace(tissue=anatomy.tissue.with_voxels(np.where(parts == largest, voxels, 0)))


def _match(config: Config, scans: _Scans, domain: Image) -> MatchedImages:
    """Match the moving image of a pair from files to the fixed image."""
    assert isinstance(config.data, FilesData)
    return match_images(config.data, config.image_options.similarity, domain, *scans)


def _match_points(
    config: Config, observed: Mapping[str, Arrays], tissue: Image, names: Sequence[str]
) -> MatchedPoints | None:
    """Find the pose of the first pairs of points or, without them, of a surface; None unless data.pose asks for it."""
    if not (isinstance(config.data, FilesData) and config.data.pose == "unknown") or config.data.moving is not None:
        return None
    for section in config.observations:
        if {"fixed", "moving"} <= set(arrays := observed.get(section.name, {})):
            return match_pairs(section.name, np.asarray(arrays["fixed"]), np.asarray(arrays["moving"]), tissue)
    for section in config.observations:
        if isinstance(section, SurfaceSection):
            return match_surface(section, observed[section.name]["points"], tissue, names)
    raise InputError("data.pose: unknown needs pairs of points or a surface, which tell the pose")


def _skull(intracranial: Path | None) -> Image | None:
    """Compute the region that sampled nodes may not enter, from a mask of where the organ may go."""
    if intracranial is None:
        return None
    return _as_stored(forbidden(without_ridges(load_mask(intracranial))))


def with_held_out(observed: Mapping[str, Arrays], config: Config) -> dict[str, Arrays]:
    """Add the landmarks of the section evaluation to the observed arrays; InputError if one is observed too."""
    observations = {name: arrays for name, arrays in observed.items() if name != NAME and arrays}
    if config.evaluation is None:
        return observations
    held_out = read_point_pairs(config.evaluation.landmarks, config.evaluation.moving_landmarks)
    pairs = {
        name: (arrays["fixed"], arrays["moving"])
        for name, arrays in observations.items()
        if {"fixed", "moving"} <= set(arrays)
    }
    require_unseen(held_out, pairs)
    return observations | {NAME: held_out.as_arrays()}


def _appraise(
    config: Config, anatomy: Anatomy, domain: Image, matched: MatchedImages | MatchedPoints | None
) -> Appraisal:
    """Appraise labels and images before the mesh is built."""
    if not (isinstance(matched, MatchedImages) and isinstance(config.data, FilesData)):
        appraisal = appraise(anatomy.tissue, domain, anatomy.names, intracranial=anatomy.intracranial)
        return appraisal if matched is None else _with_remarks(appraisal, matched)
    one_contrast = matched.matching.one_contrast and not config.image_options.similarity.serves_any_contrast
    one_scale = one_contrast and config.data.same_contrast is True
    appraisal = appraise(
        anatomy.tissue, domain, anatomy.names, matched.likeness, one_contrast, one_scale, anatomy.intracranial
    )
    return _with_remarks(appraisal, matched)


def _with_remarks(appraisal: Appraisal, matched: MatchedImages | MatchedPoints) -> Appraisal:
    return appraisal._replace(notes=matched.notes, warnings=(*appraisal.warnings, *matched.warnings))


def prepared_inputs(config: Config, observations: Sequence[Any] = ()) -> tuple[Inputs, dict[str, Any]]:
    """Prepare the inputs of a configuration, and return them with their provenance.

    Raises
    ------
    InputError
        As `prepare`, and if neither the configuration nor `observations` has an observation.
    """
    if not (config.observations or observations):
        raise InputError(
            "there is nothing observed: data has no images; add data.fixed and data.moving, landmarks under "
            "observations, or give observations to bayesreg.run"
        )
    prepared = prepare(config)
    require_all_unseen(prepared.inputs, observations)
    require_inside(prepared.inputs.mesh, config.report.places)
    appraisal = {} if prepared.appraisal is None else prepared.appraisal.as_json()
    return prepared.inputs, {"timings": prepared.timings, "pair": prepared.pair, "appraisal": appraisal}


def require_all_unseen(inputs: Inputs, observations: Sequence[Any]) -> None:
    """Raise InputError if a held-out landmark is also among observations from Python."""
    if NAME in inputs.observed:
        points = {
            observation.name: (observation.fixed_points, observation.moving_points)
            for observation in observations
            if hasattr(observation, "fixed_points")
        }
        require_unseen(PointPairs.of_arrays(inputs.observed[NAME]), points)


def with_unsampled(provenance: dict[str, Any], began: float) -> dict[str, Any]:
    """Add the seconds spent on everything except sampling; a resumed run adds them to its own time."""
    return provenance | {"unsampled": time.perf_counter() - began}


def store_inputs(folder: RunFolder, inputs: Inputs, provenance: dict[str, Any]) -> None:
    """Write the inputs of a run and their provenance into its folder; the provenance alone if it holds the inputs."""
    with folder.writing(folder.stage or "prepared") as temporary_path:
        store.write_json(temporary_path(PROVENANCE), provenance)
        if folder.stage is None:
            store.write_inputs(temporary_path, inputs)


def _require_start(config: Config, mesh: TetMesh | None = None) -> None:
    """Raise InputError if a file with displacements is unsuitable; without the mesh only its form is checked."""
    if isinstance(config.start.field, Path):
        require_displacement(config.start.field, mesh)
    if isinstance(config.known_boundary, Path) and mesh is None:
        require_displacement(config.known_boundary)


def _known_boundary(
    config: Config, mesh: TetMesh, truth: Truth | None = None, pose: Pose = IDENTITY
) -> Float[np.ndarray, "boundary 3"] | None:
    """Return the known u_B, mm, or None if the configuration gives none; see `read_boundary`."""
    if config.known_boundary is None:
        return None
    if config.known_boundary == "truth":
        assert truth is not None
        return np.asarray(truth.u)[mesh.boundary]
    return read_boundary(Path(config.known_boundary), mesh, pose)


class _Clock:
    """Stopwatch that records the seconds of each step of the preparation."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now


def _anatomy(config: Config) -> Anatomy:
    """Read the anatomy of the fixed image."""
    data = config.data
    if isinstance(data, FilesData):
        if data.labels is None:
            assert data.fixed is not None
            return without_labels(data.fixed, data.intracranial)
        assert data.label_table is not None
        return from_files(data.fixed, data.labels, data.label_table, data.intracranial)
    if isinstance(data, BrainWebData):
        return brainweb(data.labels, data.t1, data.intracranial_labels)
    return mni152()


def _mask_as_stored(mask: Image | None) -> Image | None:
    return None if mask is None else _as_stored(mask)


def _as_stored(image: Image) -> Image:
    """Round an image to the precision of a NIfTI file, so that a resumed run reads exactly the same numbers."""
    stored = in_levels(image) if np.asarray(image.voxels).dtype.kind == "f" else image
    return Image(stored.voxels, image.affine.astype(np.float32))
