"""nerf2mesh stage 1 -> baked atlases of all its cascades, with weights of the directions and with their errors."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Unpack

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.cluster.colours import Codes, codes_of, colours_of
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.surface import mlp
from nerfbake.kernels.surface.mlp import AtlasWeights
from nerfbake.kernels.surface.octahedron import TexelLookup
from nerfbake.scene.atlas import BakedAtlas, OctahedralAtlas
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import SpecularField, Stage1
from nerfbake.stages.specular_to_atlas import AtlasOptions, bake_atlas

FLOOR = 0.1  # weight of a direction that no camera uses, as a fraction of the mean, so that it is fitted too
_SAMPLE = 4096  # number of surface points


def weigh_directions(
    mesh: Mesh, cameras: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return a weight (N,) for each of N unit directions: how often cameras view the surface along it, 1 on average.

    cameras (c, 3): positions in the mesh's world coordinates. A face is weighted by its area, and counts for each
    camera in front of it; occlusion is ignored. A line of sight counts for the closest direction. Raises InvalidScene
    if no camera is in front of any face. Source: the future work of the K-means thesis (docs/sources.md).

    >>> import numpy as np
    >>> from nerfbake import Mesh, weigh_directions
    >>> triangle = Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32))
    >>> weights = weigh_directions(triangle, np.array([[9.0, 9.0, 9.0]]), np.concatenate([np.eye(3), -np.eye(3)]))
    >>> weights.shape, round(float(weights.mean()), 6)
    ((6,), 1.0)
    """
    a, b, c = (mesh.positions[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    # Points at even steps along the cumulative area: each represents the same share of the surface.
    steps = (np.arange(_SAMPLE) + 0.5) / _SAMPLE * area.sum()
    taken = np.minimum(np.searchsorted(np.cumsum(area), steps), len(area) - 1)
    points, normals = (a + b + c)[taken] / 3, across[taken]
    count = np.zeros(len(directions))
    for camera in cameras:
        sight = points - camera
        seen = sight[(sight * normals).sum(axis=1) < 0]
        count += np.bincount(np.argmax(product(seen, directions.T), axis=1), minlength=len(directions))
    if not count.any():
        raise InvalidScene(Problem("the cameras", "see no front of the mesh", "cameras in the mesh's coordinates"))
    weights = count / count.mean() + FLOOR
    return np.asarray(weights / weights.mean())


_TEXEL_BYTES = 32  # per used texel, while texels with the same error are counted (23 to 35 measured)
_COLOUR_BYTES = 180  # per distinct combination of colour, label and feature (64 to 179 measured)
_SHOWN_BYTES = 16  # per channel of a map in a direction (16 measured)


class AtlasError(NamedTuple):
    """Differences in 0..255, as means over the used texels, the directions and the three channels."""

    mae: float  # after rounding to integers, as in 8-bit pictures
    mse: float
    mae_float: float  # before rounding
    mse_float: float
    texels: int
    colours: int  # number of distinct combinations of colour, label and feature


def measure_atlas_error(
    atlas: OctahedralAtlas,
    field: SpecularField,
    *,
    directions: npt.NDArray[np.float64],
    lookup: TexelLookup = "bilinear",
    thesis_fault: bool = False,
) -> AtlasError:
    """Measure the error of an atlas over all used texels and N unit directions (N, 3).

    lookup: see kernels.surface.octahedron.read_maps(). `thesis` also truncates colours, where the others round them,
    and evaluates the MLP in float64. thesis_fault: reproduce an error of the published evaluation, which divides its
    table of directions by their L1 norm in place. It therefore evaluates the MLP at non-unit directions for all colours
    except the first one that it reads (by columns, from the bottom left). Raises InvalidScene if the textures differ
    in size, MemoryLimit. Source: docs/formats/atlas.md, "What the published code gets wrong".

    >>> import numpy as np
    >>> from nerfbake import bake_atlas, measure_atlas_error, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> atlas = bake_atlas(field, clusters=4, map_size=8)
    >>> 0 < measure_atlas_error(atlas, field, directions=np.eye(3)).mae < 64
    True
    """
    if atlas.labels.shape != field.features.shape[:2]:
        found, allowed = (f"{shape[1]}x{shape[0]}" for shape in (atlas.labels.shape, field.features.shape))
        raise InvalidScene(Problem("labels", f"have {found} texels", f"{allowed} as the feature texture has"))
    shown_channels = 3 * len(atlas.tiles) * len(directions)
    memory.require("the texture's texels", int(field.used.sum()) * _TEXEL_BYTES)
    memory.require(f"{len(atlas.tiles):,} maps in {len(directions):,} directions", shown_channels * _SHOWN_BYTES)
    if lookup == "thesis" and (field.middle or field.biases):
        raise InvalidScene(Problem("lookup", f"is thesis for an {field.mlp_text}", "nearest or bilinear"))
    codes, numbers = codes_of(field.features[field.used]), None
    if field.channels > 3:  # codes of more bits: numbers in their order replace them in the keys
        codes, numbers = np.unique(codes, return_inverse=True)
    keys, counts = np.unique(_keys(atlas, field, codes if numbers is None else numbers), return_counts=True)
    memory.require(f"{len(keys):,} colours", len(keys) * _COLOUR_BYTES)
    codes = (keys >> 40).astype(np.uint32) if numbers is None else codes[keys >> 40]
    features = colours_of((keys & 0xFFFFFF).astype(np.uint32))
    index, weight = atlas.terms((keys >> 24 & 0xFFFF).astype(np.uint16), features)
    table = atlas.show(directions, lookup).transpose(0, 2, 1).reshape(len(atlas.tiles), -1)
    shown = AtlasWeights(table, index, weight)
    asked = directions / np.abs(directions).sum(axis=1, keepdims=True) if thesis_fault else directions
    sums = _sums(field, codes, shown, asked, lookup)
    if thesis_fault:
        first = codes == codes_of(_first_met(field))
        met = AtlasWeights(table, index[first], weight[first])
        sums[first] = _sums(field, codes[first], met, directions, lookup)
    means = (counts[:, None] * sums).sum(axis=0) / (counts.sum() * table.shape[1])
    mae, mse, mae_float, mse_float = means.tolist()
    return AtlasError(mae, mse, mae_float, mse_float, int(counts.sum()), len(keys))


def _keys(atlas: OctahedralAtlas, field: SpecularField, colours: npt.NDArray[Any]) -> npt.NDArray[np.uint64]:
    """Return a 64-bit key per used texel of all that its error depends on: colour, label, feature code.

    colours: a number below 2^24 for each used texel's colour.
    """
    keys = colours.astype(np.uint64) << np.uint64(40)
    keys |= atlas.labels[field.used].astype(np.uint64) << np.uint64(24)
    if atlas.features is not None:
        keys |= codes_of(atlas.features[field.used])
    return keys


def _first_met(field: SpecularField) -> npt.NDArray[np.uint8]:
    column = int(np.argmax(field.used.any(axis=0)))
    row = int(np.flatnonzero(field.used[:, column])[-1])
    first: npt.NDArray[np.uint8] = field.features[row, column]
    return first


def _sums(
    field: SpecularField,
    codes: Codes,
    shown: AtlasWeights,
    directions: npt.NDArray[np.float64],
    lookup: TexelLookup,
) -> npt.NDArray[np.float64]:
    """Return the differences (m, 4) of m texels, see kernels.surface.mlp.differences()."""
    features = colours_of(codes, field.channels) / 255
    if lookup == "thesis":
        return mlp.exact_differences(features, directions, field.w0, field.w1, shown)
    return mlp.differences(features, mlp.split_layers(directions, *field.mlp), shown)


DirectionSet = Literal["fibonacci", "cameras"]
HELD_OUT = 617  # number of held-out directions: a prime, so that the spiral repeats no direction of the usual sets

_BAKED = 0.75  # progress when the atlases are baked and not measured yet


def bake_stage1(
    stage1: Stage1,
    *,
    directions: int = 100,
    direction_set: DirectionSet = "fibonacci",
    **options: Unpack[AtlasOptions],
) -> BakedAtlas:
    """Bake an atlas for each cascade, and measure its error. Other options go to bake_atlas().

    directions: number of evenly spread directions for both. direction_set: `cameras` weights each direction by how
    often the training cameras view the cascade's mesh along it; errors remain evenly weighted. Raises InvalidScene if
    this requires cameras or a mesh that are missing.

    >>> from nerfbake import bake_stage1, sample_stage1
    >>> baked = bake_stage1(sample_stage1(resolution=16), directions=20, clusters=4, map_size=8)
    >>> print(baked.atlases[0])
    kmeans atlas of 4 maps of 8x8
    """
    evenly = fibonacci(directions)
    weights = _weights(stage1, direction_set, evenly)
    with progress.part(0, _BAKED):
        atlases = tuple(
            memory.kept(bake_atlas(field, directions=evenly, direction_weights=own, **options))
            for field, own in progress.each(list(zip(stage1.fields, weights, strict=True)))
        )
    with progress.part(_BAKED, 1):
        errors = [
            measure_atlas_error(atlas, field, directions=evenly)._asdict()
            for atlas, field in progress.each(list(zip(atlases, stage1.fields, strict=True)))
        ]
    facts = {"bake": {"directions": directions, "direction_set": direction_set, **options}, "errors": errors}
    return BakedAtlas(atlases, stage1.meshes, stage1.files, facts)


def _weights(
    stage1: Stage1, direction_set: DirectionSet, directions: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.float64] | None]:
    """Return the weights of the directions for each cascade, or None if all have the same weight."""
    if direction_set == "fibonacci":
        return [None] * len(stage1.fields)
    if stage1.cameras is None:
        raise InvalidScene(Problem("transforms.json", "is missing", "one, with `direction_set=cameras`"))
    weights: list[npt.NDArray[np.float64] | None] = []
    for cascade, mesh in enumerate(stage1.meshes):
        if mesh is None:
            raise InvalidScene(Problem(f"mesh_{cascade}.obj", "is missing", "one, with `direction_set=cameras`"))
        weights.append(weigh_directions(mesh, stage1.cameras, directions))
    return weights


def measure_stage1_error(
    baked: BakedAtlas,
    stage1: Stage1,
    *,
    directions: int = 100,
    held_out: bool = False,
    lookup: TexelLookup = "bilinear",
    thesis_fault: bool = False,
) -> list[AtlasError]:
    """Measure the error of each cascade's atlas.

    held_out: use directions that are not in any bake, instead of those of the bake. Raises InvalidScene if the numbers
    of atlases and cascades differ.

    >>> from nerfbake import bake_stage1, measure_stage1_error, sample_stage1
    >>> stage1 = sample_stage1(resolution=16)
    >>> (error,) = measure_stage1_error(bake_stage1(stage1, clusters=4, map_size=8), stage1, held_out=True)
    >>> error.texels == int(stage1.fields[0].used.sum())
    True
    """
    if len(baked.atlases) != len(stage1.fields):
        raise InvalidScene(
            Problem(
                "the atlas", f"has {len(baked.atlases)} cascades", f"{len(stage1.fields)} as the stage-1 folder has"
            )
        )
    asked = fibonacci(HELD_OUT if held_out else directions)
    return [
        measure_atlas_error(atlas, field, directions=asked, lookup=lookup, thesis_fault=thesis_fault)
        for atlas, field in zip(baked.atlases, stage1.fields, strict=True)
    ]
