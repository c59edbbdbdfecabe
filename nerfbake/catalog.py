"""The two tables: every format and every stage. The rest of the program looks things up here.

Modules are named as strings and imported on first use, so that nothing heavy loads before it is needed.
A new format is one file and one line; a new stage is one file and one line. A test holds both to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import PurePath
from typing import NamedTuple, cast

from nerfbake import contract
from nerfbake.errors import InvalidFile, UsageError


class Format(NamedTuple):
    """A way to write a scene as the bytes of a file."""

    name: str  # what --to takes and info prints
    scene: str  # name of the scene type that it holds
    suffix: str  # the ending of its files
    module: str  # in `formats`: what contract.FileFormat says, contract.VolumeFormat if it holds volumes
    title: str
    companion: str | None = None  # a file `<stem><companion>` that says more about this one
    readable: bool = True  # False: written for people to look at, without decode() and recognise()
    beside: bool = False  # decode() takes the folder where the file stands, too
    packed: bool = False  # there is nothing left for .zst to pack, so that it is refused
    written: str = ""  # name of the scene type that encode() takes, where it is not the one that decode() gives
    writable: bool = True  # False: other programs' files, which are read alone, without encode()

    def load_module(self) -> contract.FileFormat:
        return cast(contract.FileFormat, import_module(f"nerfbake.formats.{self.module}"))

    def load_volume_module(self) -> contract.VolumeFormat:
        return cast(contract.VolumeFormat, self.load_module())

    def load_packed_module(self) -> contract.PackedFormat:
        return cast(contract.PackedFormat, self.load_module())

    def load_page_module(self) -> contract.PageFormat:
        return cast(contract.PageFormat, self.load_module())

    def require_options(self, given: Mapping[str, object]) -> None:
        """Raises UsageError for options that the format does not take, or other values than it takes."""
        contract.require_options(self.name, self.load_module().encode, given)

    def choices(self, option: str) -> tuple[str, ...]:
        """The values that an option of the format may have, its default first; none if it has no such option."""
        known = contract.options_of(self.load_module().encode)
        return known[option].choices if option in known else ()


class FolderKind(NamedTuple):
    """A kind of folder that holds a scene."""

    name: str  # what info prints
    scene: str  # name of the scene type that it holds
    module: str  # in `formats`: what contract.FolderFormat says
    title: str
    key: str  # the file by which it is known
    members: tuple[str, ...] = ()  # files that stand for the folder, as they mean nothing without the others
    writable: bool = True  # False: other programs' folders, which are read alone, without encode()

    def load_module(self) -> contract.FolderFormat:
        return cast(contract.FolderFormat, import_module(f"nerfbake.formats.{self.module}"))

    def require_options(self, given: Mapping[str, object]) -> None:
        """Raises UsageError for options that this kind of folder does not take, or other values than it takes."""
        contract.require_options(self.name, self.load_module().encode, given)


AnyFormat = Format | FolderKind

_OCTREE = "SparseVoxelOctree"

# Longer endings stand before the endings they contain. Formats that share an ending are asked in this order.
FORMATS = (
    Format("svo.npz", _OCTREE, ".svo.npz", "octree.npz", "octree, plain NumPy arrays"),
    Format("svo.pb", _OCTREE, ".svo.pb", "octree.protobuf", "octree, Protocol Buffers"),
    Format("svo.json", _OCTREE, ".svo.json", "octree.json", "octree, JSON"),
    Format("svo.bson", _OCTREE, ".svo.bson", "octree.bson", "octree, BSON"),
    Format("svo.fb", _OCTREE, ".svo.fb", "octree.flatbuffers", "octree, FlatBuffers"),
    Format("svo.capnp", _OCTREE, ".svo.capnp", "octree.capnp", "octree, Cap'n Proto"),
    Format("svoq", _OCTREE, ".svoq", "octree.svoq", "octree, compressed", written="QuantisedOctree", packed=True),
    Format("vdb.npz", "Volume", ".vdb.npz", "volume.npz", "VDB grids, plain NumPy arrays"),
    Format("ckpt.npz", "LatticeField", ".ckpt.npz", "field.svox2", "Plenoxels (svox2)", writable=False),
    Format("npz", "N3Tree", ".npz", "field.n3tree", "PlenOctree (svox N3Tree)", "_poses_bounds.npy"),
    Format("depth.png", "Depth", ".depth.png", "picture.depth_png", "depth, thousandths of a world unit"),
    Format("depth.npy", "Depth", ".depth.npy", "picture.depth_npy", "depth, world units"),
    Format("png", "Image", ".png", "picture.png", "picture"),
    Format("gif", "Animation", ".gif", "picture.gif", "moving picture", readable=False),
    Format("html", "Comparison", ".html", "page.comparison", "page of a comparison", readable=False),
    Format("html", "Page", ".html", "page.view", "page to look around in", readable=False),
    Format("json", "Cameras", ".json", "camera.transforms", "cameras (transforms.json)", beside=True),
    Format("vdb", "Volume", ".vdb", "volume.openvdb", "OpenVDB grids"),
    Format("nvdb", "Volume", ".nvdb", "volume.nanovdb", "NanoVDB grid"),
    Format("tar", "LatticeField", ".tar", "field.dvgo", "DirectVoxGO", writable=False),
    Format("th", "LatticeField", ".th", "field.tensorf", "TensoRF", writable=False),
    Format("obj", "Meshes", ".obj", "mesh.obj", "Wavefront mesh"),
    Format("glb", "Meshes", ".glb", "mesh.glb", "glTF 2.0 mesh"),
)

# Folders: encode() gives names with their bytes, decode() takes them. The first writable one of a type is written.
# A folder that is of several kinds is read as the first of them that holds what is wanted: of a capture its
# transforms.json, then COLMAP's model, from which LLFF's poses were made.
_COLMAP = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_LLFF, _NSVF, _BAKED = ("poses_bounds.npy",), ("intrinsics.txt",), ("scene_params.json",)
_BLOCKS = "sparse_grid_block_indices.png"
FOLDERS = (
    FolderKind("stage1", "Stage1", "mesh.stage1", "nerf2mesh's stage 1", key="mlp.json"),
    FolderKind("atlas", "BakedAtlas", "atlas.folder", "octahedral atlas", key="atlas.json"),
    FolderKind("thesis", "BakedAtlas", "atlas.thesis", "the thesis' atlas", key="octahedron_maps.png", writable=False),
    FolderKind("transforms", "Cameras", "camera.transforms_folder", "capture's cameras", key="transforms.json"),
    FolderKind("colmap", "Cameras", "camera.colmap", "COLMAP model", "sparse/0/images.bin", _COLMAP, writable=False),
    FolderKind("llff", "Cameras", "camera.llff", "LLFF's poses", "poses_bounds.npy", _LLFF, writable=False),
    FolderKind("nsvf", "Cameras", "camera.nsvf", "NSVF's capture", "intrinsics.txt", _NSVF, writable=False),
    FolderKind("plenvdb", "LatticeField", "field.plenvdb", "PlenVDB's folder", key="finedensity.vdb"),
    FolderKind("merf", "LatticeField", "field.merf", "MERF's folder", _BLOCKS, _BAKED, writable=False),
    FolderKind("snerg", "LatticeField", "field.snerg", "SNeRG's folder", "scene_params.json", _BAKED, writable=False),
)

# A further ending of any format: zstd's frames, whose module has compress and decompress.
COMPRESSED = ".zst"
COMPRESSION = "nerfbake.formats.wire.zstd"
COMPRESSION_MAGIC = b"\x28\xb5\x2f\xfd"

# What holds no scene by itself, and is read by one command alone.
PHOTOGRAPHS = "nerfbake.formats.wire.photograph"
CHECKPOINTS = "nerfbake.formats.wire.checkpoint"

LFS_POINTER = b"version https://git-lfs.github.com/spec/"

SCENES = {
    "Animation": "nerfbake.scene.animation",
    "BakedAtlas": "nerfbake.scene.atlas",
    "BrickField": "nerfbake.scene.brick_field",
    "Camera": "nerfbake.scene.camera",
    "Cameras": "nerfbake.scene.camera",
    "Comparison": "nerfbake.scene.comparison",
    "Depth": "nerfbake.scene.depth",
    "Image": "nerfbake.scene.image",
    "IndexGrid": "nerfbake.scene.vdb",
    "HeldOut": "nerfbake.scene.held_out",
    "LatticeField": "nerfbake.scene.lattice_field",
    "Mesh": "nerfbake.scene.mesh",
    "Meshes": "nerfbake.scene.mesh",
    "N3Tree": "nerfbake.scene.n3tree",
    "OctahedralAtlas": "nerfbake.scene.atlas",
    "SparseVoxelOctree": "nerfbake.scene.octree",
    "SpecularField": "nerfbake.scene.specular",
    "Compression": "nerfbake.scene.compression",
    "Page": "nerfbake.scene.page",
    "PageField": "nerfbake.scene.page_field",
    "PageSurface": "nerfbake.scene.page_surface",
    "QuantisedOctree": "nerfbake.scene.quantised_octree",
    "RadianceField": "nerfbake.scene.radiance_field",
    "Stage1": "nerfbake.scene.stage1",
    "VdbTree": "nerfbake.scene.vdb",
    "Views": "nerfbake.scene.views",
    "Volume": "nerfbake.scene.volume",
}

STAGES = {
    "carve_hull": "nerfbake.stages.views_to_hull",
    "field_of_page_field": "nerfbake.stages.page_field_to_field",
    "fit_field": "nerfbake.stages.views_to_field",
    "sphere_cameras": "nerfbake.stages.scene_to_cameras",
    "lattice_of_octree": "nerfbake.stages.octree_to_lattice",
    "lower_basis": "nerfbake.stages.octree_to_octree",
    "quantise_octree": "nerfbake.stages.octree_to_quantised",
    "weigh_leaves": "nerfbake.stages.field_to_importance",
    "compress_octree": "nerfbake.stages.octree_to_compression",
    "bake_atlas": "nerfbake.stages.specular_to_atlas",
    "bake_stage1": "nerfbake.stages.stage1_to_atlas",
    "bricks_of_octree": "nerfbake.stages.octree_to_brick_field",
    "build_field": "nerfbake.stages.scene_to_field",
    "build_hull": "nerfbake.stages.field_to_mesh",
    "build_octree": "nerfbake.stages.n3tree_to_octree",
    "build_page_field": "nerfbake.stages.field_to_page_field",
    "build_page_surface": "nerfbake.stages.stage1_to_page_surface",
    "build_vdb": "nerfbake.stages.octree_to_vdb",
    "build_views": "nerfbake.stages.pictures_to_views",
    "cast_volume": "nerfbake.stages.vdb_to_vdb",
    "cluster_identifiers": "nerfbake.stages.identifiers_to_clusters",
    "cluster_planes": "nerfbake.stages.identifiers_to_clusters",
    "compare_scenes": "nerfbake.stages.scenes_to_comparison",
    "render_field_and_meshes": "nerfbake.stages.field_and_meshes_to_image",
    "cut_octree": "nerfbake.stages.octree_to_octree",
    "fill_octree": "nerfbake.stages.brick_field_to_octree",
    "field_of_bricks": "nerfbake.stages.brick_field_to_field",
    "field_of_n3tree": "nerfbake.stages.n3tree_to_field",
    "field_of_octree": "nerfbake.stages.octree_to_field",
    "field_of_volume": "nerfbake.stages.volume_to_field",
    "n3tree_of_bricks": "nerfbake.stages.brick_field_to_n3tree",
    "octree_of_bricks": "nerfbake.stages.brick_field_to_octree",
    "octree_of_density": "nerfbake.stages.vdb_to_octree",
    "refit_bricks": "nerfbake.stages.brick_field_to_brick_field",
    "render_meshes": "nerfbake.stages.meshes_to_image",
    "identify_colours": "nerfbake.stages.specular_to_identifiers",
    "measure_atlas_error": "nerfbake.stages.atlas_to_error",
    "measure_lattice": "nerfbake.stages.lattice_to_error",
    "measure_stage1_error": "nerfbake.stages.stage1_to_atlas",
    "measure_views": "nerfbake.stages.views_to_error",
    "orbit_cameras": "nerfbake.stages.scene_to_cameras",
    "render_field": "nerfbake.stages.field_to_image",
    "octree_of_lattice": "nerfbake.stages.lattice_to_octree",
    "octree_of_volume": "nerfbake.stages.vdb_to_octree",
    "sample_n3tree": "nerfbake.stages.shapes_to_n3tree",
    "sample_stage1": "nerfbake.stages.shapes_to_stage1",
    "round_field": "nerfbake.stages.field_to_page_field",
    "round_to_bytes": "nerfbake.stages.page_field_to_field",
    "render_lattice": "nerfbake.stages.lattice_to_image",
    "render_stage1": "nerfbake.stages.stage1_to_image",
    "bake_snapped_maps": "nerfbake.stages.clusters_to_maps",
    "summarise_scene": "nerfbake.stages.scene_to_summary",
    "view": "nerfbake.stages.scene_to_page",
    "vdb_of_bricks": "nerfbake.stages.brick_field_to_vdb",
    "weigh_directions": "nerfbake.stages.cameras_to_directions",
}


# What people call the scenes, and what they may do with one that a command does not take.
NOUNS = {
    "Animation": "a moving picture",
    "BakedAtlas": "an atlas folder",
    "Cameras": "cameras",
    "Comparison": "a page of a comparison",
    "Depth": "a depth map",
    "Image": "a picture",
    "LatticeField": "a lattice field",
    "Meshes": "a mesh",
    "N3Tree": "a PlenOctree",
    "Page": "a page to look around in",
    "QuantisedOctree": "a compressed octree",
    "SparseVoxelOctree": "an octree",
    "Stage1": "a stage-1 folder",
    "Volume": "a volume",
}
ADVICE = {
    "Cameras": "`cameras` takes them",
    "LatticeField": "`nerfbake svo` makes an octree of it",
    "N3Tree": "`nerfbake svo` makes an octree of it",
    "SparseVoxelOctree": "`nerfbake convert` writes it in other formats",
    "Stage1": "`nerfbake atlas` bakes it",
    "Volume": "`nerfbake convert` makes an octree of it",
}


def load_compression() -> contract.Compression:
    return cast(contract.Compression, import_module(COMPRESSION))


def load_photographs() -> contract.Photographs:
    return cast(contract.Photographs, import_module(PHOTOGRAPHS))


def load_checkpoints() -> contract.Checkpoints:
    return cast(contract.Checkpoints, import_module(CHECKPOINTS))


def uncompressed(name: str) -> str:
    """A path, or a format's name, without the ending of a compressed file."""
    return name[: -len(COMPRESSED)] if name.lower().endswith(COMPRESSED) else name


def scene_name(path: str) -> str:
    """The name of a scene: its file's without the endings of its format, or its folder's."""
    name = PurePath(path).name
    plain = uncompressed(name)
    suffix = next((form.suffix for form in FORMATS if plain.lower().endswith(form.suffix)), "")
    return plain[: len(plain) - len(suffix)] or name


def compressed(form: Format) -> Format:
    """The same format in a compressed file."""
    return form._replace(name=form.name + COMPRESSED, suffix=form.suffix + COMPRESSED)


def format_named(name: str, scene: str) -> Format:
    """The format of this name that holds this scene type. Raises UsageError."""
    known = formats_of(scene)
    for form in known:
        if form.name == name.removeprefix("."):
            return form
    names = ", ".join(form.name for form in known)
    raise UsageError(f"{NOUNS[scene]} is not written as {name!r}; allowed: {names}, each with .zst behind it")


def format_of_path(path: str, scene: str) -> Format:
    """The format of this scene type that a file's ending stands for. Raises UsageError."""
    known = formats_of(scene)
    for form in known:
        if path.lower().endswith(form.suffix):
            return form
    endings = ", ".join(form.suffix for form in known)
    raise UsageError(f"{path!r} has no ending that {NOUNS[scene]} is written with; allowed: {endings}, or `to=FORMAT`")


def is_ending(path: str, scene: str) -> bool:
    """True if a file's ending stands for a format of this scene type."""
    return path.lower().removesuffix(COMPRESSED).endswith(tuple(form.suffix for form in formats_of(scene)))


def formats_of(scene: str) -> list[Format]:
    """The formats that write this scene type."""
    return [form for form in FORMATS if form.writable and (form.written or form.scene) == scene]


def folders_of(scene: str) -> list[FolderKind]:
    """The kinds of folders that hold this scene type, one that is written before others."""
    return [form for form in FOLDERS if form.scene == scene]


def folder_to_write(scene: str) -> FolderKind:
    """The kind of folder that this scene type is written as. Raises UsageError."""
    written = [kind for kind in FOLDERS if kind.writable]
    for kind in written:
        if kind.scene == scene:
            return kind
    known = ", ".join(dict.fromkeys(kind.scene for kind in written))
    raise UsageError(f"a {scene} is not written as a folder; allowed: {known}")


def folder_of_content(files: Mapping[str, memoryview], *wanted: str) -> FolderKind:
    """The kind of folder that these files are; of several the first that holds a wanted scene. Raises InvalidFile."""
    for form in sorted(FOLDERS, key=lambda form: form.scene not in wanted):
        if form.load_module().recognise(files):
            return form
    names = [form.key for form in FOLDERS if not wanted or form.scene in wanted] or [form.key for form in FOLDERS]
    raise InvalidFile(
        f"is a folder that nerfbake does not know; allowed: a file, or a folder with {' or '.join(names)}"
    )


def folder_of_member(name: str, files: Mapping[str, memoryview]) -> FolderKind | None:
    """The kind of folder that a file of this name stands for among these files, if there is one: of several the first
    that is of these files, or else the last."""
    known = [form for form in FOLDERS if name in form.members]
    return next((form for form in known[:-1] if form.load_module().recognise(files)), known[-1] if known else None)


def require_content(head: bytes) -> None:
    """Raises InvalidFile for what stands in a checkout for a file that was not fetched, whatever its name is."""
    if head.startswith(LFS_POINTER):
        raise InvalidFile("is a Git-LFS pointer, not the file itself; allowed: the file, which `git lfs pull` fetches")


def format_of_content(path: str, view: memoryview) -> Format:
    """The format of something to read, by its ending; where that leaves several, by what each says of the bytes.

    A stream has no ending, and some endings cover others: an octree's .svo.npz may have been renamed to .npz.
    """
    known = [form for form in FORMATS if form.readable]
    by_ending = [form for form in known if path.lower().endswith(form.suffix)]
    likely = [form for form in known if not by_ending or form.suffix.endswith(by_ending[0].suffix)]
    for form in likely if len(likely) > 1 else []:
        if form.load_module().recognise(view):
            return form
    if by_ending:
        return by_ending[0]
    start = bytes(view[:8]).hex(" ") or "nothing"
    endings = ", ".join(form.suffix for form in known)
    raise InvalidFile(f"starts with {start}, as no known format does; allowed: {endings}")
