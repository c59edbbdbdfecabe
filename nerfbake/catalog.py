"""Tables of all file formats and folder kinds, and functions that look them up.

Modules are named as strings and imported on first use, so that nothing heavy is loaded before it is needed. A new
format is one file and one line in a table; a new stage is one file and one line. A test checks this.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from importlib import import_module
from pathlib import PurePath
from typing import NamedTuple, cast

from nerfbake import contract
from nerfbake.errors import InvalidFile, UsageError


class Format(NamedTuple):
    """A file format of a scene."""

    name: str  # value of --to, and printed by info
    scene: str  # name of the scene type that decode() returns
    suffix: str  # file extension
    module: str  # in `formats`: implements contract.FileFormat, or contract.VolumeFormat for volumes
    title: str
    companion: str | None = None  # a file `<stem><companion>` with further facts about this one
    readable: bool = True  # False: for viewing only, without decode() and recognise()
    beside: bool = False  # decode() also takes the folder that contains the file
    packed: bool = False  # the format is compressed already, so .zst is rejected
    written: str = ""  # name of the scene type that encode() takes, if it differs from `scene`
    writable: bool = True  # False: files of other programs, which are only read; there is no encode()
    in_gzip: bool = False  # the format may be a gzip stream
    spread: tuple[str, ...] = ()  # extensions of the files that may be written beside it; see contract.SpreadFormat
    library: str = ""  # a module that decode() needs and that may not be installed; see contract.StoredFormat

    def load_module(self) -> contract.FileFormat:
        return cast(contract.FileFormat, import_module(f"nerfbake.formats.{self.module}"))

    def load_volume_module(self) -> contract.VolumeFormat:
        return cast(contract.VolumeFormat, self.load_module())

    def load_splat_module(self) -> contract.SplatFormat:
        return cast(contract.SplatFormat, self.load_module())

    def load_examined_module(self) -> contract.ExaminedFormat | None:
        """Return the module if it can examine a file."""
        module = self.load_module()
        return cast(contract.ExaminedFormat, module) if hasattr(module, "examine") else None

    def load_packed_module(self) -> contract.PackedFormat:
        return cast(contract.PackedFormat, self.load_module())

    def load_spread_module(self) -> contract.SpreadFormat:
        return cast(contract.SpreadFormat, self.load_module())

    def load_stored_module(self) -> contract.StoredFormat:
        return cast(contract.StoredFormat, self.load_module())

    def load_page_module(self) -> contract.PageFormat:
        return cast(contract.PageFormat, self.load_module())

    def require_options(self, given: Mapping[str, object]) -> None:
        """Raise UsageError if the format does not take an option or its value."""
        contract.require_options(self.name, self.load_module().encode, given)

    def choices(self, option: str) -> tuple[str, ...]:
        """The accepted values of an option, its default first; empty if the format has no such option."""
        known = contract.options_of(self.load_module().encode)
        return known[option].choices if option in known else ()


class FolderKind(NamedTuple):
    """A kind of folder that contains a scene."""

    name: str  # what info prints
    scene: str  # name of the scene type that decode() returns
    module: str  # in `formats`: implements contract.FolderFormat
    title: str
    key: str  # the file that identifies this kind
    members: tuple[str, ...] = ()  # files that may be given instead of the folder, because they cannot be read alone
    writable: bool = True  # False: folders of other programs, which are only read; there is no encode()

    def load_module(self) -> contract.FolderFormat:
        return cast(contract.FolderFormat, import_module(f"nerfbake.formats.{self.module}"))

    def load_splat_module(self) -> contract.SplatStore:
        return cast(contract.SplatStore, self.load_module())

    def require_options(self, given: Mapping[str, object]) -> None:
        """Raise UsageError if this kind of folder does not take an option or its value."""
        contract.require_options(self.name, self.load_module().encode, given)


class Dialect(NamedTuple):
    """Cameras of another tool: a file of a capture, or one of many files that are read together."""

    title: str  # the tool, as `Cameras.dialect`
    module: str  # in `formats`: implements contract.CameraDialect
    endings: tuple[str, ...]  # of the file's name; '' for any
    places: tuple[str, ...] = ("",)  # subfolders of a capture in which the file may be; (): only read if it is named
    needs: tuple[str, ...] = ()  # one of these files of the capture is needed, too, if it is not empty
    is_many: bool = False  # all files of this kind in a folder are read together
    is_shared: bool = False  # such files hold other scenes, too, and are cameras only where these are wanted
    head: int = contract.HEAD_CAMERAS  # bytes of a file that recognise() gets, if the file is named
    scene: str = "Cameras"
    written_as: str = ""  # value of --to, if the module has encode()

    @property
    def name(self) -> str:
        """What `info` prints as the format."""
        return self.module.rpartition(".")[2]

    def load_module(self) -> contract.CameraDialect:
        return cast(contract.CameraDialect, import_module(f"nerfbake.formats.{self.module}"))

    def load_writer(self) -> contract.WrittenDialect:
        return cast(contract.WrittenDialect, self.load_module())


AnyFormat = Format | FolderKind

_OCTREE = "SparseVoxelOctree"
_USD, _PICTURES, _BESIDE = "pxr", (".png", ".jpg"), (".png", ".vdb")

# Longer extensions come before the extensions they contain. Formats with the same extension are tried in this order.
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
    Format("hdr", "EnvironmentMap", ".hdr", "picture.hdr", "environment map (Radiance)", writable=False),
    Format("gif", "Animation", ".gif", "picture.gif", "moving picture", readable=False),
    Format("html", "Comparison", ".html", "page.comparison", "page of a comparison", readable=False),
    Format("html", "Shipment", ".html", "page.shipment", "receipt of a shipment", readable=False),
    Format("html", "Page", ".html", "page.view", "page to look around in", readable=False),
    Format("json", "Cameras", ".json", "camera.transforms", "cameras (transforms.json)", beside=True),
    Format("vdb", "Volume", ".vdb", "volume.openvdb", "OpenVDB grids"),
    Format("nvdb", "Volume", ".nvdb", "volume.nanovdb", "NanoVDB grid"),
    Format("tar", "LatticeField", ".tar", "field.dvgo", "DirectVoxGO", writable=False),
    Format("tar", "FunctionField", ".tar", "field.nerf_pytorch", "nerf-pytorch", beside=True, writable=False),
    Format("pt", "N3Tree", ".pt", "field.svraster", "SVRaster", writable=False),
    Format("pth", "FunctionField", ".pth", "field.kilonerf", "KiloNeRF", beside=True, writable=False),
    Format("pth", "FunctionField", ".pth", "field.torch_ngp", "torch-ngp", writable=False),
    Format("ckpt", "FunctionField", ".ckpt", "field.nerfstudio", "nerfstudio", beside=True, writable=False),
    Format("ingp", "FunctionField", ".ingp", "field.instant_ngp", "instant-ngp", writable=False, in_gzip=True),
    Format("msgpack", "FunctionField", ".msgpack", "field.instant_ngp", "instant-ngp", writable=False),
    Format("msgpack", "FunctionField", ".msgpack", "field.jaxnerf", "JaxNeRF, NeRF-SH", beside=True, writable=False),
    Format("th", "LatticeField", ".th", "field.tensorf", "TensoRF", writable=False),
    Format("obj", "Meshes", ".obj", "mesh.obj", "Wavefront mesh", beside=True, spread=(".mtl", ".png", ".jpg")),
    Format("glb", "Splats", ".glb", "splat.glb", "Gaussian splats in glTF 2.0"),
    Format("glb", "Meshes", ".glb", "mesh.glb", "glTF 2.0 mesh"),
    Format("ply", "Meshes", ".ply", "mesh.ply", "PLY mesh with vertex colours"),
    Format("ply", "Splats", ".ply", "splat.ply", "Gaussian splats (3DGS)"),
    Format("usda", "Splats", ".usda", "splat.usda", "Gaussian splats in USD, text", library=_USD),
    Format("usdc", "Splats", ".usdc", "splat.usdc", "Gaussian splats in USD", library=_USD),
    Format("usdz", "Splats", ".usdz", "splat.usdz", "Gaussian splats in USD, package", library=_USD),
    Format("usd", "Splats", ".usd", "splat.usd", "Gaussian splats in USD", writable=False, library=_USD),
    Format("usda", "Meshes", ".usda", "mesh.usda", "USD mesh, text", beside=True, spread=_PICTURES, library=_USD),
    Format("usdc", "Meshes", ".usdc", "mesh.usdc", "USD mesh", beside=True, spread=_PICTURES, library=_USD),
    Format("usdz", "Meshes", ".usdz", "mesh.usdz", "USD mesh, package", library=_USD),
    Format("usd", "Meshes", ".usd", "mesh.usd", "USD mesh", beside=True, writable=False, library=_USD),
    Format("usda", "Cameras", ".usda", "camera.usda", "cameras in USD, text", library=_USD),
    Format("usdc", "Cameras", ".usdc", "camera.usdc", "cameras in USD", library=_USD),
    Format("usdz", "Cameras", ".usdz", "camera.usdz", "cameras in USD, package", library=_USD),
    Format("usd", "Cameras", ".usd", "camera.usd", "cameras in USD", writable=False, library=_USD),
    Format("usda", "Volume", ".usda", "volume.usda", "USD stage of a .vdb, text", readable=False, spread=(".vdb",)),
    Format("usdc", "Volume", ".usdc", "volume.usdc", "USD stage of a .vdb", readable=False, spread=(".vdb",)),
    Format("usda", "SceneVariants", ".usda", "variants.usda", "USD variants, text", readable=False, spread=_BESIDE),
    Format("usdz", "SceneVariants", ".usdz", "variants.usdz", "USD variants, package", readable=False),
    Format("spz", "Splats", ".spz", "splat.spz", "Gaussian splats, compressed (Niantic)", in_gzip=True),
    Format("sog", "Splats", ".sog", "splat.sog", "Gaussian splats, compressed (PlayCanvas)"),
    Format("ksplat", "Splats", ".ksplat", "splat.ksplat", "Gaussian splats (GaussianSplats3D)", writable=False),
    Format("splat", "Splats", ".splat", "splat.splat", "Gaussian splats, 32 bytes each", writable=False),
)

# encode() returns file names with their bytes, and decode() takes them. A scene is written as the first writable kind
# of its type. A folder of several kinds is read as the first of them that contains a wanted scene type: for a capture
# transforms.json, then the COLMAP model, from which LLFF's poses are computed.
_COLMAP = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_LLFF, _NSVF, _BAKED = ("poses_bounds.npy",), ("intrinsics.txt",), ("scene_params.json",)
_SOG = ("meta.json", "lod-meta.json")
_MOBILE = "shape0.pngfeat0.png"
_BLOCKS = "sparse_grid_block_indices.png"
FOLDERS = (
    FolderKind("stage1", "Stage1", "mesh.stage1", "nerf2mesh's stage 1", key="mlp.json"),
    FolderKind("mobilenerf", "Stage1", "mesh.mobilenerf", "MobileNeRF's folder", _MOBILE, writable=False),
    FolderKind("atlas", "BakedAtlas", "atlas.folder", "octahedral atlas", key="atlas.json"),
    FolderKind("thesis", "BakedAtlas", "atlas.thesis", "the thesis' atlas", key="octahedron_maps.png", writable=False),
    FolderKind("nerfstudio", "FunctionField", "field.nerfstudio_run", "nerfstudio's run", "config.yml", writable=False),
    FolderKind("transforms", "Cameras", "camera.transforms_folder", "capture's cameras", key="transforms.json"),
    FolderKind("colmap", "Cameras", "camera.colmap", "COLMAP model", "sparse/0/images.bin", _COLMAP),
    FolderKind("llff", "Cameras", "camera.llff", "LLFF's poses", "poses_bounds.npy", _LLFF, writable=False),
    FolderKind("nsvf", "Cameras", "camera.nsvf", "NSVF's capture", "intrinsics.txt", _NSVF, writable=False),
    FolderKind("plenvdb", "LatticeField", "field.plenvdb", "PlenVDB's folder", key="finedensity.vdb"),
    FolderKind("merf", "LatticeField", "field.merf", "MERF's folder", _BLOCKS, _BAKED, writable=False),
    FolderKind("sog_folder", "Splats", "splat.sog_folder", "folder of a .sog", "meta.json", _SOG),
    FolderKind("sog_levels", "SplatLevels", "splat.sog_levels", "levels of splats", "lod-meta.json", _SOG[1:]),
    FolderKind("snerg", "LatticeField", "field.snerg", "SNeRG's folder", "scene_params.json", _BAKED, writable=False),
)

# Cameras of other tools, by how many people need them: of several files in a folder, the first line here is read. A
# folder of FOLDERS comes before them. Their contents are recognised, not only their names.
_TEXT = (".txt",)
_INTRINSICS = ("intrinsics.txt", "calib.txt")
_EUROC = ("mav0/state_groundtruth_estimate0", "state_groundtruth_estimate0")
DIALECTS = (
    Dialect("Metashape", "camera.metashape", (".xml", ".psx")),
    Dialect("RealityCapture", "camera.realitycapture_xmp", (".xmp",), ("", "images"), is_many=True),
    Dialect("RealityCapture", "camera.realitycapture_csv", (".csv", *_TEXT)),
    Dialect("3D Gaussian Splatting", "camera.gaussian_cameras", (".json",), written_as="3dgs"),
    Dialect(
        "Polycam",
        "camera.polycam",
        (".json",),
        ("keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras"),
        is_many=True,
    ),
    Dialect("Record3D", "camera.record3d", ("metadata", "metadata.json"), ("", "EXR_RGBD")),
    Dialect("OpenSfM", "camera.opensfm", (".json",), ("", "opensfm")),
    Dialect("OpenDroneMap", "camera.opendronemap", (".geojson",), ("", "odm_report")),
    Dialect("Meshroom", "camera.meshroom", (".sfm", ".json")),
    Dialect("NeuS", "camera.neus", (".npz",)),
    Dialect("Bundler", "camera.bundler", (".out", *_TEXT), ("", "bundle")),
    Dialect("TUM", "camera.tum", _TEXT, needs=_INTRINSICS),
    Dialect("KITTI", "camera.kitti", _TEXT, needs=_INTRINSICS),
    Dialect("7-Scenes", "camera.seven_scenes", (".pose.txt",), needs=_INTRINSICS, is_many=True),
    Dialect("MVSNet", "camera.mvsnet", ("_cam.txt",), ("cams", ""), is_many=True),
    Dialect("OpenMVG", "camera.openmvg", (".json",)),
    Dialect("NVM", "camera.nvm", (".nvm",)),
    Dialect("Open3D", "camera.open3d", (".log",), needs=_INTRINSICS),
    Dialect("Open3D", "camera.open3d_json", (".json",)),
    Dialect("kapture", "camera.kapture", ("sensors.txt",), ("sensors", "")),
    Dialect("EuRoC", "camera.euroc", ("data.csv",), _EUROC),
    # VTK sorts the keys of a .gltf: its buffers, with all their data, stand before its cameras.
    Dialect("glTF", "camera.gltf", (".glb", ".gltf"), (), is_shared=True, head=1 << 25),
)
_MOST_HEADS = 50  # files of a subfolder whose beginnings are read to recognise a dialect

# Files of cameras that are not read, by the ends of their names: the tool, and what it can export instead.
UNREAD = (
    (".abc", "Alembic", "Meshroom's cameras.sfm"),
    (".r3d", "Record3D", "the unpacked archive, with its file metadata"),
    (".rcproj", "RealityCapture", "its .xmp files or its CSV of camera parameters"),
    (".rsproj", "RealityScan", "its .xmp files or its CSV of camera parameters"),
    (".psz", "Metashape", "its cameras.xml"),
    (".p4d", "Pix4D", "a COLMAP model"),
    ("sfm_data.bin", "OpenMVG", "its sfm_data.json"),
    (".traj", "ARKitScenes", "transforms.json"),
)

# An additional extension of any format: zstd frames. The module has compress() and decompress().
COMPRESSED = ".zst"
COMPRESSION = "nerfbake.formats.wire.zstd"
COMPRESSION_MAGIC = b"\x28\xb5\x2f\xfd"

# What other programs put around a file of any format: gzip, or a zip archive.
WRAPPING = "nerfbake.formats.wire.wrapping"
ARCHIVES = (".npz", ".sog", ".tar", ".pt", ".pth", ".ckpt", ".th", ".usdz")  # formats that are zip archives themselves

LFS_POINTER = b"version https://git-lfs.github.com/spec/"

# Names of the scene types in messages, and advice if a command does not take a scene.
NOUNS = {
    "Animation": "a moving picture",
    "BakedAtlas": "an atlas folder",
    "Cameras": "cameras",
    "Comparison": "a page of a comparison",
    "Depth": "a depth map",
    "EnvironmentMap": "an environment map",
    "FunctionField": "a trained field",
    "Image": "a picture",
    "LatticeField": "a lattice field",
    "Meshes": "a mesh",
    "N3Tree": "a PlenOctree",
    "Page": "a page to look around in",
    "QuantisedOctree": "a compressed octree",
    "SceneVariants": "variants of a scene",
    "Shipment": "the receipt of a shipment",
    "SparseVoxelOctree": "an octree",
    "SplatLevels": "levels of Gaussian splats",
    "Splats": "Gaussian splats",
    "Stage1": "a stage-1 folder",
    "Volume": "a volume",
}
ADVICE = {
    "Cameras": "`cameras` takes them",
    "EnvironmentMap": "`mesh --environment` takes it",
    "SparseVoxelOctree": "`nerfbake convert` writes it in other formats, and `nerfbake vdb` as a volume",
    "Stage1": "`nerfbake atlas` bakes it",
    "Volume": "`nerfbake convert` makes an octree of it",
}
FIELDS = ("FunctionField", "LatticeField", "N3Tree", "SparseVoxelOctree", "Splats")
MAKERS = {"Meshes": "mesh", "SparseVoxelOctree": "svo", "Splats": "splats", "Volume": "vdb"}  # of FIELDS


def load_compression() -> contract.CompressionFormat:
    return cast(contract.CompressionFormat, import_module(COMPRESSION))


def load_wrapping() -> contract.WrappingFormat:
    return cast(contract.WrappingFormat, import_module(WRAPPING))


def load_photographs() -> contract.PhotographFormat:
    return cast(contract.PhotographFormat, import_module("nerfbake.formats.wire.picture"))


def load_videos() -> contract.VideoFormat:
    return cast(contract.VideoFormat, import_module("nerfbake.formats.wire.video"))


def load_checkpoints() -> contract.CheckpointFormat:
    return cast(contract.CheckpointFormat, import_module("nerfbake.formats.wire.checkpoint"))


def uncompressed(name: str) -> str:
    """Remove the extension of a compressed file (.zst) from a path or a format's name."""
    return name[: -len(COMPRESSED)] if name.lower().endswith(COMPRESSED) else name


def scene_name(path: str) -> str:
    """The name of a scene: its file name without the extensions of its format, or its folder's name."""
    name = PurePath(path).name
    plain = uncompressed(name)
    return plain[: len(plain) - len(format_suffix(plain))] or name


def format_suffix(path: str) -> str:
    """Return the longest extension of a format that the path ends with, in lower case; '' if there is none."""
    return next((form.suffix for form in FORMATS if path.lower().endswith(form.suffix)), "")


def compressed(form: Format) -> Format:
    """The same format, compressed with zstd."""
    return form._replace(name=form.name + COMPRESSED, suffix=form.suffix + COMPRESSED)


def format_named(name: str, scene: str) -> Format:
    """Return the format of this name that stores this scene type. Raises UsageError."""
    known = formats_of(scene)
    for form in known:
        if form.name == name.removeprefix("."):
            return form
    names = ", ".join(form.name for form in known)
    raise UsageError(f"{NOUNS[scene]} cannot be written as {name!r}; allowed: {names}, each also with .zst")


def format_of_path(path: str, scene: str) -> Format:
    """Return the format of this scene type that has the path's extension. Raises UsageError."""
    known = formats_of(scene)
    for form in known:
        if path.lower().endswith(form.suffix):
            return form
    if path.lower().endswith(".usdz") and scene == "Volume":
        raise UsageError(
            "a .usdz cannot contain a .vdb; allowed: .usda or .usdc, which are written with a .vdb beside it"
        )
    makers = [f"`nerfbake {name}` makes {NOUNS[made]}" for made, name in MAKERS.items() if is_ending(path, made)]
    endings, other = ", ".join(form.suffix for form in known), f" ({', '.join(makers)})" if makers else ""
    raise UsageError(f"{path!r} has no file extension for {NOUNS[scene]}{other}; allowed: {endings}, or `to=FORMAT`")


def is_ending(path: str, scene: str) -> bool:
    """True if the path has the extension of a format for this scene type."""
    return path.lower().removesuffix(COMPRESSED).endswith(tuple(form.suffix for form in formats_of(scene)))


def formats_of(scene: str) -> list[Format]:
    """The formats that can write this scene type."""
    return [form for form in FORMATS if form.writable and (form.written or form.scene) == scene]


def folders_of(scene: str) -> list[FolderKind]:
    """The kinds of folders that contain this scene type, in order of preference for writing."""
    return [form for form in FOLDERS if form.scene == scene]


def folder_to_write(scene: str) -> FolderKind:
    """Return the kind of folder that this scene type is written as. Raises UsageError."""
    written = [kind for kind in FOLDERS if kind.writable]
    if found := [kind for kind in written if kind.scene == scene]:
        return found[0]
    known = ", ".join(dict.fromkeys(kind.scene for kind in written))
    raise UsageError(f"a {scene} cannot be written as a folder; allowed: {known}")


def folder_of_key(path: str) -> FolderKind | None:
    """Return the kind of folder that is written if OUT is this path, its key; None for any other file."""
    name = PurePath(path).name
    return next((kind for kind in FOLDERS if kind.writable and kind.key == name and name in kind.members), None)


def folder_of_content(files: Mapping[str, memoryview], *wanted: str) -> FolderKind:
    """Return the kind of folder that these files form. Raises InvalidFile.

    If several kinds match, the first one with a wanted scene type is returned.
    """
    for form in sorted(FOLDERS, key=lambda form: form.scene not in wanted):
        if form.load_module().recognise(files):
            return form
    names = [form.key for form in FOLDERS if not wanted or form.scene in wanted] or [form.key for form in FOLDERS]
    raise InvalidFile(f"is a folder of unknown kind; allowed: a file, or a folder with {' or '.join(names)}")


def folder_of_member(name: str, files: Mapping[str, memoryview]) -> FolderKind | None:
    """Return the kind of folder that a file of this name represents, or None.

    If several kinds have a member of this name, the first one that recognises the files is returned, else the last one.
    """
    known = [form for form in FOLDERS if name in form.members]
    return next((form for form in known[:-1] if form.load_module().recognise(files)), known[-1] if known else None)


def dialect_of(name: str, head: bytes) -> Dialect | None:
    """Return the tool whose cameras a file holds, or None. name: its path in the capture; head: its first bytes."""
    last = name.rpartition("/")[2].lower()
    known = (form for form in DIALECTS if last.endswith(form.endings))
    return next((form for form in known if form.load_module().recognise(name, head)), None)


def dialects_in(files: contract.HeadedFiles) -> list[tuple[Dialect, str]]:
    """Return the files of cameras of other tools in a folder, with their tools, in the order of DIALECTS.

    Of files that are read together, the first one is returned.
    """
    found: dict[Dialect, list[str]] = {}
    for place in dict.fromkeys(place for form in DIALECTS for place in form.places):
        forms = [form for form in DIALECTS if place in form.places]
        endings = tuple(ending for form in forms for ending in form.endings)
        names = [name for name in files.names(place) if name.lower().endswith(endings) and not name.startswith(".")]
        for name in names[:_MOST_HEADS]:
            path = f"{place}/{name}" if place else name
            form = dialect_of(path, files.head(path, contract.HEAD_CAMERAS))
            if form in forms:
                found.setdefault(form, []).append(path)
    return [(form, path) for form in DIALECTS for path in found.get(form, [])[: 1 if form.is_many else None]]


def cameras_to_write(ending: str, to: str | None) -> AnyFormat | Dialect | None:
    """Return what cameras are written as, by the extension of OUT or by `to`; None for what stores other scenes."""
    known: dict[str, AnyFormat | Dialect] = {form.written_as: form for form in DIALECTS if form.written_as}
    known |= {kind.name: kind for kind in folders_of("Cameras") if kind.writable}
    if to is not None and to in known:
        return known[to]
    plain = uncompressed(ending).lower()
    suffix = format_suffix(plain)
    return next((form for form in formats_of("Cameras") if form.suffix == suffix), None)


def is_tool(dialect: str) -> bool:
    """Return whether cameras of this dialect were read from a file of DIALECTS."""
    return any(form.title == dialect for form in DIALECTS)


def lacks(form: Dialect, files: Container[str]) -> str:
    """Return the files that cameras need and that a folder lacks, in words; '' if it has them."""
    return "" if not form.needs or any(name in files for name in form.needs) else " or ".join(form.needs)


def unread_file(name: str) -> tuple[str, str] | None:
    """Return the tool of a file of cameras that is not read, and what to export instead; None for any other file."""
    return next(((tool, advice) for ending, tool, advice in UNREAD if name.lower().endswith(ending)), None)


def require_content(head: bytes) -> None:
    """Raise InvalidFile if the file is a Git-LFS pointer, whatever its name is."""
    if head.startswith(LFS_POINTER):
        raise InvalidFile("is a Git-LFS pointer, not the file itself; allowed: the file, which `git lfs pull` fetches")


def format_of_content(path: str, view: memoryview, *wanted: str) -> Format:
    """Return the format of a file or stream to read: by its extension, then by its content.

    The content decides if several formats remain. A stage of USD may have several kinds of scenes: of these, the first
    that is `wanted`, by its name, is returned. A stream has no extension, and an octree's .svo.npz may be named .npz.
    """
    known = [form for form in FORMATS if form.readable]
    by_ending = [form for form in known if path.lower().endswith(form.suffix)]
    likely = [form for form in known if not by_ending or form.suffix.endswith(by_ending[0].suffix)]
    for form in likely if len(likely) > 1 else []:
        if form.load_module().recognise(view):
            others = (each for each in likely if form.library and each.library and each.scene in wanted)
            return next((each for each in others if each.load_module().recognise(view)), form)
    if by_ending:
        return by_ending[0]
    if unread := unread_file(path):
        raise InvalidFile(f"is a file of {unread[0]}, which is not read; allowed: {unread[1]}")
    if load_videos().container_of(bytes(view[:16])):
        raise InvalidFile("is a video; allowed: a folder of its frames, which `nerfbake frames` makes")
    start, endings = bytes(view[:8]).hex(" ") or "nothing", ", ".join(dict.fromkeys(form.suffix for form in known))
    raise InvalidFile(f"starts with {start}, which is no known format; allowed: {endings}")
