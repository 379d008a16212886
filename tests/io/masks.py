"""Random masks of the kinds that thresholds, classifiers and tired hands make, on small grids."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from bayesreg.image import Image

SIZES = ((1.0, 1.0, 1.0), (2.0, 2.0, 2.0), (0.8, 0.8, 2.5), (1.0, 1.5, 4.0))
NAMES = ("organ", "core")


def random_mask(seed: int) -> tuple[str, Image, tuple[str, ...]]:
    """Make a mask of a kind that the seed chooses in turn; return its kind, the labels, and their names.

    Every third mask has two tissues, and every other one an oblique grid.
    """
    random = np.random.default_rng(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    sizes = np.array(SIZES[random.integers(len(SIZES))])
    mask = KINDS[kind](random, tuple(np.maximum(np.rint(48 / np.cbrt(sizes / sizes.min())), 12).astype(int)))
    affine = np.eye(4)
    turn = Rotation.random(random_state=seed) if random.random() < 0.5 else Rotation.identity()
    affine[:3, :3] = turn.as_matrix() * sizes
    affine[:3, 3] = random.uniform(-100, 100, 3)
    if random.random() < 2 / 3:
        return kind, Image(mask.astype(np.int8), affine), NAMES[:1]
    core = ndimage.gaussian_filter(random.normal(size=mask.shape), 4.0) > 0
    if not (mask & core).any() or not (mask & ~core).any():
        core = np.cumsum(mask.ravel()).reshape(mask.shape) > mask.sum() / 2
    return kind, Image(np.where(mask, 1 + core, 0).astype(np.int8), affine), NAMES


def body(random: np.random.Generator, shape: tuple[int, ...], least: float = 0.2, most: float = 0.4) -> np.ndarray:
    """Fill a ball, a box or something between them, with half axes that are shares of the grid's extents."""
    half = random.uniform(least, most, 3) * shape
    centre = np.array([random.uniform(h + 1, n - h - 1) for h, n in zip(half, shape, strict=True)])
    order = random.choice([1.5, 2.0, 4.0, 100.0])
    return (np.abs((_index(shape) - centre) / half) ** order).sum(axis=-1) < 1


def islets(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A body with islands of a voxel to a tenth of it, some of them in contact with it."""
    mask = body(random, shape)
    for _ in range(random.integers(1, 12)):
        mask |= body(random, shape, 0.01, random.choice([0.02, 0.06, 0.15]))
    return mask


def bridge(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Two bodies and a bridge of a voxel between them."""
    parts = [body(random, shape, *extent) for extent in ((0.15, 0.25), random.choice([(0.05, 0.1), (0.15, 0.25)]))]
    ends = [np.argwhere(part)[random.integers(part.sum())] for part in parts]
    count = 2 * max(shape)
    line = np.rint(np.linspace(*ends, count)).astype(int)
    mask = parts[0] | parts[1]
    mask[tuple(line.T)] = True
    return mask


def contacts(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Boxes that meet in an edge or a corner, or a body with grains on its surface."""
    if random.random() < 0.5:
        mask = body(random, shape)
        rim = ndimage.binary_dilation(mask) ^ ndimage.binary_erosion(mask)
        return mask ^ (rim & (random.random(shape) < random.uniform(0.05, 0.4)))
    mask, middle = np.zeros(shape, bool), np.array(shape) // 2
    half = (random.uniform(0.2, 0.4, (2, 3)) * shape).astype(int)
    mask[tuple(slice(m - h, m) for m, h in zip(middle, half[0], strict=True))] = True
    along = random.integers(3) if random.random() < 0.7 else -1
    start = middle - np.where(np.arange(3) == along, half[0] // 2, 0)
    mask[tuple(slice(s, s + h) for s, h in zip(start, half[1], strict=True))] = True
    return mask


def shell(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A closed shell, or a bowl, of one to four voxels."""
    mask = body(random, shape, 0.25, 0.4)
    mask &= ~ndimage.binary_erosion(mask, iterations=int(random.integers(1, 5)))
    if random.random() < 0.5:
        mask[:, :, : int(shape[2] * random.uniform(0.3, 0.6))] = False
    return mask


def slab(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A slab of two voxels, flat or bent, alone or on a body."""
    across = random.integers(3)
    along = np.delete(np.arange(3), across)
    offset = _index(shape) - np.array(shape) / 2
    half = random.uniform(0.15, 0.4, 2) * np.array(shape)[along]
    height = offset[..., across] - random.choice([0.0, 0.2]) * (offset[..., along] ** 2).sum(axis=-1) / max(shape)
    mask = (np.abs(offset[..., along]) < half).all(axis=-1) & (np.abs(height) < 1)
    return mask if random.random() < 0.5 else mask | body(random, shape, 0.1, 0.2)


def box(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """The whole grid, or a box inside it."""
    mask, margin = np.zeros(shape, bool), int(random.choice([0, 0, 1, 4]))
    mask[tuple(slice(margin, n - margin) for n in shape)] = True
    return mask


def border(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A body that the border of the grid cuts."""
    wide = tuple(int(1.5 * n) for n in shape)
    start = random.integers(0, np.array(wide) - shape + 1)
    mask = body(random, wide, 0.3, 0.4)[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))]
    return mask if mask.any() else np.ones(shape, bool)


def threshold(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """The bright part of noise in a body: sheets, tunnels, islands and pits, as in a head above Otsu's threshold."""
    noise = ndimage.gaussian_filter(random.normal(size=shape), random.uniform(1.0, 3.0))
    inside = ndimage.gaussian_filter(body(random, shape, 0.3, 0.42).astype(float), 2.0)
    return inside * (1 + random.uniform(0.3, 0.6) * noise / noise.std()) > 0.5


def mixture(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Two of the other kinds together, or one less the other."""
    first, second = (KINDS[kind](random, shape) for kind in random.choice(list(KINDS)[:-1], 2, replace=False))
    mask = first | second if random.random() < 0.6 else first & ~second
    return mask if mask.any() else first


def _index(shape: tuple[int, ...]) -> np.ndarray:
    return np.moveaxis(np.indices(shape), 0, -1) + 0.5


KINDS: dict[str, Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]] = {
    "islets": islets,
    "bridge": bridge,
    "contacts": contacts,
    "shell": shell,
    "slab": slab,
    "box": box,
    "border": border,
    "threshold": threshold,
    "mixture": mixture,
}
