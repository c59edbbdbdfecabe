"""nerfbake: bakes trained radiance fields into what engines, DCC tools, web pages and shaders can use.

    from nerfbake import load, save, build_octree

    octree = build_octree(load("chair.npz"), resolution=128)
    save("chair.svo.pb", octree)

Names are imported on first use, so that `import nerfbake` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nerfbake.catalog import SCENES, STAGES

if TYPE_CHECKING:
    from nerfbake.cli.python import fit as fit
    from nerfbake.io import load as load
    from nerfbake.io import save as save
    from nerfbake.memory import memory_limit as memory_limit
    from nerfbake.scene.animation import Animation as Animation
    from nerfbake.scene.atlas import BakedAtlas as BakedAtlas
    from nerfbake.scene.atlas import OctahedralAtlas as OctahedralAtlas
    from nerfbake.scene.brick_field import BrickField as BrickField
    from nerfbake.scene.camera import Camera as Camera
    from nerfbake.scene.camera import Cameras as Cameras
    from nerfbake.scene.comparison import Comparison as Comparison
    from nerfbake.scene.compression import Compression as Compression
    from nerfbake.scene.depth import Depth as Depth
    from nerfbake.scene.held_out import HeldOut as HeldOut
    from nerfbake.scene.image import Image as Image
    from nerfbake.scene.lattice_field import LatticeField as LatticeField
    from nerfbake.scene.mesh import Mesh as Mesh
    from nerfbake.scene.mesh import Meshes as Meshes
    from nerfbake.scene.n3tree import N3Tree as N3Tree
    from nerfbake.scene.octree import SparseVoxelOctree as SparseVoxelOctree
    from nerfbake.scene.page import Page as Page
    from nerfbake.scene.page_field import PageField as PageField
    from nerfbake.scene.page_surface import PageSurface as PageSurface
    from nerfbake.scene.quantised_octree import QuantisedOctree as QuantisedOctree
    from nerfbake.scene.radiance_field import RadianceField as RadianceField
    from nerfbake.scene.specular import SpecularField as SpecularField
    from nerfbake.scene.stage1 import Stage1 as Stage1
    from nerfbake.scene.vdb import IndexGrid as IndexGrid
    from nerfbake.scene.vdb import VdbTree as VdbTree
    from nerfbake.scene.views import Views as Views
    from nerfbake.scene.volume import Volume as Volume
    from nerfbake.stages.atlas_to_error import measure_atlas_error as measure_atlas_error
    from nerfbake.stages.brick_field_to_brick_field import refit_bricks as refit_bricks
    from nerfbake.stages.brick_field_to_field import field_of_bricks as field_of_bricks
    from nerfbake.stages.brick_field_to_n3tree import n3tree_of_bricks as n3tree_of_bricks
    from nerfbake.stages.brick_field_to_octree import fill_octree as fill_octree
    from nerfbake.stages.brick_field_to_octree import octree_of_bricks as octree_of_bricks
    from nerfbake.stages.brick_field_to_vdb import vdb_of_bricks as vdb_of_bricks
    from nerfbake.stages.cameras_to_directions import weigh_directions as weigh_directions
    from nerfbake.stages.clusters_to_maps import bake_snapped_maps as bake_snapped_maps
    from nerfbake.stages.field_and_meshes_to_image import render_field_and_meshes as render_field_and_meshes
    from nerfbake.stages.field_to_image import render_field as render_field
    from nerfbake.stages.field_to_importance import weigh_leaves as weigh_leaves
    from nerfbake.stages.field_to_mesh import build_hull as build_hull
    from nerfbake.stages.field_to_page_field import build_page_field as build_page_field
    from nerfbake.stages.field_to_page_field import round_field as round_field
    from nerfbake.stages.identifiers_to_clusters import cluster_identifiers as cluster_identifiers
    from nerfbake.stages.identifiers_to_clusters import cluster_planes as cluster_planes
    from nerfbake.stages.lattice_to_error import measure_lattice as measure_lattice
    from nerfbake.stages.lattice_to_image import render_lattice as render_lattice
    from nerfbake.stages.lattice_to_octree import octree_of_lattice as octree_of_lattice
    from nerfbake.stages.meshes_to_image import render_meshes as render_meshes
    from nerfbake.stages.n3tree_to_field import field_of_n3tree as field_of_n3tree
    from nerfbake.stages.n3tree_to_octree import build_octree as build_octree
    from nerfbake.stages.octree_to_brick_field import bricks_of_octree as bricks_of_octree
    from nerfbake.stages.octree_to_compression import compress_octree as compress_octree
    from nerfbake.stages.octree_to_field import field_of_octree as field_of_octree
    from nerfbake.stages.octree_to_lattice import lattice_of_octree as lattice_of_octree
    from nerfbake.stages.octree_to_octree import cut_octree as cut_octree
    from nerfbake.stages.octree_to_octree import lower_basis as lower_basis
    from nerfbake.stages.octree_to_quantised import quantise_octree as quantise_octree
    from nerfbake.stages.octree_to_vdb import build_vdb as build_vdb
    from nerfbake.stages.page_field_to_field import field_of_page_field as field_of_page_field
    from nerfbake.stages.page_field_to_field import round_to_bytes as round_to_bytes
    from nerfbake.stages.pictures_to_views import build_views as build_views
    from nerfbake.stages.scene_to_cameras import orbit_cameras as orbit_cameras
    from nerfbake.stages.scene_to_cameras import sphere_cameras as sphere_cameras
    from nerfbake.stages.scene_to_field import build_field as build_field
    from nerfbake.stages.scene_to_page import view as view
    from nerfbake.stages.scene_to_summary import summarise_scene as summarise_scene
    from nerfbake.stages.scenes_to_comparison import compare_scenes as compare_scenes
    from nerfbake.stages.shapes_to_n3tree import sample_n3tree as sample_n3tree
    from nerfbake.stages.shapes_to_stage1 import sample_stage1 as sample_stage1
    from nerfbake.stages.specular_to_atlas import bake_atlas as bake_atlas
    from nerfbake.stages.specular_to_identifiers import identify_colours as identify_colours
    from nerfbake.stages.stage1_to_atlas import bake_stage1 as bake_stage1
    from nerfbake.stages.stage1_to_atlas import measure_stage1_error as measure_stage1_error
    from nerfbake.stages.stage1_to_image import render_stage1 as render_stage1
    from nerfbake.stages.stage1_to_page_surface import build_page_surface as build_page_surface
    from nerfbake.stages.vdb_to_octree import octree_of_density as octree_of_density
    from nerfbake.stages.vdb_to_octree import octree_of_volume as octree_of_volume
    from nerfbake.stages.vdb_to_vdb import cast_volume as cast_volume
    from nerfbake.stages.views_to_error import measure_views as measure_views
    from nerfbake.stages.views_to_field import fit_field as fit_field
    from nerfbake.stages.views_to_hull import carve_hull as carve_hull
    from nerfbake.stages.volume_to_field import field_of_volume as field_of_volume

__version__ = "0.1.0"

_HOMES = {
    "NerfbakeError": "nerfbake.errors",
    "fit": "nerfbake.cli.python",
    "load": "nerfbake.io",
    "memory_limit": "nerfbake.memory",
    "save": "nerfbake.io",
    **SCENES,
    **STAGES,
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'nerfbake' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
