"""The interface of every format and every kind of folder, and errors for unknown options."""

from __future__ import annotations

import ast
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from nerfbake import build_octree, build_vdb, catalog, contract, load
from nerfbake.catalog import AnyFormat
from nerfbake.contract import Option, options_of
from nerfbake.errors import InvalidFile, InvalidScene, UsageError
from nerfbake.io import save, save_folder
from nerfbake.scene.camera import Camera, Cameras
from tests.conftest import REPOSITORY
from tests.support.scenes import n3tree
from tests.support.source import parsed

READ = [form for form in catalog.FORMATS if form.readable]
WRITTEN: list[AnyFormat] = [
    *(form for form in catalog.FORMATS if form.writable),
    *dict.fromkeys(catalog.folder_to_write(each.scene) for each in catalog.FOLDERS if each.writable),
]
every_written = pytest.mark.parametrize("form", WRITTEN, ids=lambda form: form.name)


# -- signatures ------------------------------------------------------------------------------------------------
def parameters(function: Callable[..., Any]) -> tuple[list[str], dict[str, inspect.Parameter]]:
    """The names of the positional parameters, and the keyword-only parameters by name."""
    known = inspect.signature(function).parameters
    assert all(each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL) for each in known.values())
    keywords = {name: each for name, each in known.items() if each.kind == inspect.Parameter.KEYWORD_ONLY}
    return [name for name in known if name not in keywords], keywords


def is_plain(kind: Any) -> bool:
    """True for a type whose values can be written on a command line and in a message."""
    if get_origin(kind) in (Union, types.UnionType):
        return all(is_plain(each) for each in get_args(kind))
    return get_origin(kind) in (Literal, Mapping) or kind in (bool, int, float, types.NoneType) or is_mapping(kind)


def is_mapping(kind: Any) -> bool:
    return isinstance(get_origin(kind), type) and issubclass(get_origin(kind), Mapping)


@every_written
def test_encode_takes_a_scene_and_options_with_types_and_defaults(form: AnyFormat) -> None:
    encode = form.load_module().encode
    scene, options = parameters(encode)
    hints = get_type_hints(encode)
    written = form.written if isinstance(form, catalog.Format) and form.written else form.scene
    assert [hints[name].__name__ for name in scene] == [written]
    for name, option in options.items():
        assert is_plain(hints[name]), name
        assert option.default is not inspect.Parameter.empty, name
        assert Option(hints[name], option.default).allows(option.default), name
    assert list(options_of(encode)) == list(options)


@pytest.mark.parametrize("form", READ, ids=lambda form: form.name)
def test_a_format_recognises_and_decodes_a_view(form: catalog.Format) -> None:
    module = form.load_module()
    assert parameters(module.recognise) == (["view"], {})
    given, beside = parameters(module.decode)
    assert given == ["view"]
    # decode() takes the arguments that the catalog declares.
    assert ("companion" in beside, "beside" in beside) == (bool(form.companion), form.beside)
    assert set(beside) <= {"companion", "beside"}
    assert get_type_hints(module.decode)["return"].__name__ == form.scene


@pytest.mark.parametrize("form", [form for form in catalog.FORMATS if not form.readable], ids=lambda form: form.name)
def test_what_is_only_written_does_not_say_that_it_is_read(form: catalog.Format) -> None:
    assert not any(hasattr(form.load_module(), name) for name in ("decode", "recognise"))


@pytest.mark.parametrize("form", [form for form in READ if not form.writable], ids=lambda form: form.name)
def test_what_is_only_read_is_not_written(form: catalog.Format) -> None:
    assert not hasattr(form.load_module(), "encode")
    assert form not in catalog.formats_of(form.scene)


@pytest.mark.parametrize("kind", catalog.FOLDERS, ids=lambda kind: kind.name)
def test_a_folder_recognises_and_decodes_files(kind: catalog.FolderKind) -> None:
    module = kind.load_module()
    assert parameters(module.recognise) == (["files"], {})
    given, member = parameters(module.decode)
    assert given == ["files"]
    assert ("member" in member) >= bool(kind.members)
    assert get_type_hints(module.decode)["return"].__name__ == kind.scene


def test_only_folders_that_are_written_have_encode() -> None:
    for kind in catalog.FOLDERS:
        assert hasattr(kind.load_module(), "encode") == kind.writable, kind.name
    known = "Stage1, BakedAtlas, Cameras, LatticeField, Splats, SplatLevels"
    with pytest.raises(UsageError, match=f"a Volume cannot be written as a folder; allowed: {known}"):
        catalog.folder_to_write("Volume")


@pytest.mark.parametrize("form", catalog.formats_of("Volume"), ids=lambda form: form.name)
def test_a_format_of_volumes_says_what_it_can_hold(form: catalog.Format) -> None:
    module = form.load_volume_module()
    for half in (False, True):
        module.require_grids(module.DEFAULT_GRIDS, half=half)
    module.require_grids(module.FIELD_GRIDS, half=False)
    assert isinstance(module.KEEPS_HALVES, bool)
    assert module.HALF_NOTE is None or isinstance(module.HALF_NOTE, str)


GRIDS = [("density",), ("Cd",), ("sh",), ("index",), ("density", "Cd"), ("density", "sh"), ("density", "Cd", "sh")]


@pytest.mark.parametrize("form", catalog.formats_of("Volume"), ids=lambda form: form.name)
def test_grids_are_refused_beforehand_exactly_if_they_cannot_be_written(form: catalog.Format, tmp_path: Path) -> None:
    octree, module = build_octree(n3tree(data_format="SH4")), form.load_volume_module()
    for grids in GRIDS:
        for half in (False, True):
            try:
                module.require_grids(grids, half=half)
            except UsageError:
                with pytest.raises(InvalidScene):
                    save(tmp_path / f"a{form.suffix}", build_vdb(octree, grids=grids, half=half), force=True)
            else:
                save(tmp_path / f"a{form.suffix}", build_vdb(octree, grids=grids, half=half), force=True)


# -- options ---------------------------------------------------------------------------------------------------
@every_written
def test_a_wrong_option_is_one_line_that_names_the_format(form: AnyFormat) -> None:
    with pytest.raises(UsageError) as error:
        form.require_options({"colour": 1})
    assert str(error.value).startswith(f"{form.name} takes no option 'colour'; allowed: ")
    assert str(error.value).endswith("allowed: none") == (not options_of(form.load_module().encode))


@every_written
def test_a_wrong_value_is_one_line_that_names_what_is_allowed(form: AnyFormat) -> None:
    for name, option in options_of(form.load_module().encode).items():
        for wrong in ("x\n", ["x"], np.zeros(3)):
            with pytest.raises(UsageError) as error:
                form.require_options({name: wrong})
            assert str(error.value).startswith(f"option {name!r} of {form.name} is ")
            assert str(error.value).endswith(f"; allowed: {option.allowed}")
        form.require_options({name: option.default})


def test_saving_goes_through_it_and_leaves_nothing(tmp_path: Path) -> None:
    octree = build_octree(n3tree())
    for name, options, said in (
        ("a.svo.npz", {"profile": "bulk"}, r"svo\.npz takes no option 'profile'; allowed: no_child \(0, -1\)"),
        ("a.svo.pb", {"profile": "x"}, r"option 'profile' of svo\.pb is 'x'; allowed: report, bulk"),
        ("a.svo.pb.zst", {"no_child": 1}, r"option 'no_child' of svo\.pb\.zst is 1; allowed: 0, -1"),
    ):
        with pytest.raises(UsageError, match=said):
            save(tmp_path / name, octree, **options)
    cameras = Cameras((Camera(4, 4, (4.0, 4.0), np.eye(4), "a"),))
    with pytest.raises(UsageError, match="transforms takes no option 'up'; allowed: none"):
        save_folder(tmp_path / "capture", cameras, up="y")
    with pytest.raises(UsageError, match="a SparseVoxelOctree cannot be written as a folder; allowed: Stage1"):
        save_folder(tmp_path / "octree", octree)
    assert not list(tmp_path.iterdir())


def test_what_an_option_allows() -> None:
    def encode(
        scene: object,
        *,
        codec: Literal["zip", "none"] = "none",
        least: float | None = None,
        sides: Mapping[str, int] | None = None,
        half: bool = False,
    ) -> None: ...

    known = options_of(encode)
    assert known["codec"].choices == ("none", "zip")
    assert (known["codec"].allowed, known["least"].allowed) == ("zip, none", "a number, None")
    assert all(known["least"].allows(value) for value in (1, 1.5, np.float32(1), None))
    assert not any(known["least"].allows(value) for value in (True, "1"))
    assert [known["half"].allows(value) for value in (True, False, 1, None)] == [True, True, False, False]
    assert known["sides"].allows({"a": 1})
    assert not known["sides"].allows(["a"])


# -- recognising -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("form", READ, ids=lambda form: form.name)
def test_nobody_recognises_noise(form: catalog.Format) -> None:
    noise = np.random.default_rng(0)
    for size in (0, 1, 7, 64, 5000):
        assert not form.load_module().recognise(memoryview(noise.bytes(size)))


@pytest.mark.parametrize("kind", catalog.FOLDERS, ids=lambda kind: kind.name)
def test_no_kind_of_folder_recognises_other_files(kind: catalog.FolderKind, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"none of ours")
    with pytest.raises(InvalidFile, match="is a folder of unknown kind"):
        load(tmp_path)
    assert not kind.load_module().recognise(_Empty())


class _Empty(dict[str, memoryview]):
    """A folder without files."""

    def names(self, folder: str) -> list[str]:
        return []

    def head(self, name: str) -> bytes:
        return b""


# -- no format names elsewhere --------------------------------------------------------------------------------
def literals(path: Path) -> Iterator[tuple[int, str]]:
    """The string literals of a file, without help texts and docstrings."""
    tree = parsed(path)
    words: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            words |= set(ast.walk(node)) if isinstance(node.value, ast.Constant) else set()
        if isinstance(node, ast.keyword) and node.arg in ("help", "short_help", "metavar"):
            words |= set(ast.walk(node))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in words:
            yield node.lineno, node.value


# Commands name picture formats by extension for folders of pictures, and for depth maps beside them.
PICTURES = {form.name for scene in ("Image", "Depth", "Animation") for form in catalog.formats_of(scene)}
WORDS = {"json", "html"}  # also names of options: they count as formats only after a dot


def test_no_command_names_a_format() -> None:
    """By name or by extension. transforms.json and similar names are files in folders, not formats."""
    names = {form.name for form in catalog.FORMATS} - PICTURES
    assert {"vdb", "nvdb", "vdb.npz", "svo.pb"} < names
    found = []
    for folder in ("cli", "jobs"):
        for path in sorted((REPOSITORY / "nerfbake" / folder).rglob("*.py")):
            for line, text in literals(path):
                words = {word.strip(",;:()'") for word in text.split()}
                if words & {f".{name}" for name in names} or text in names - WORDS:
                    found.append(f"{path.name}:{line} {text!r}")
    assert found == []


# -- protocols -------------------------------------------------------------------------------------------------
def require_functions(module: object, protocol: type, *, read: bool = True) -> None:
    """Modules are cast to their protocol, so mypy does not compare them. read: the format is also read."""
    names = [name for each in protocol.__mro__ for name, value in vars(each).items() if inspect.isfunction(value)]
    names = [name for name in names if read or name not in ("decode", "recognise")]
    missing = [name for name in names if not name.startswith("_") and not hasattr(module, name)]
    assert missing == [], f"{module} lacks functions of {protocol.__name__}"


def test_modules_have_the_functions_of_their_protocols() -> None:
    for form in catalog.FORMATS:
        if form.scene == "Volume":
            protocol = contract.VolumeFormat if form.readable else contract.SpreadFormat
            require_functions(form.load_volume_module(), protocol, read=form.readable)
        if form.scene == "Splats" and form.writable:
            assert form.load_splat_module().MOST_DEGREE in range(5)
            assert form.load_splat_module().KEEPS_ORIGIN in (True, False)
            assert form.load_splat_module().KEEPS_UP in (True, False)
        if form.library and form.writable and form.scene != "Cameras":  # which nothing reads back
            require_functions(form.load_stored_module(), contract.StoredFormat)
        if form.packed:
            require_functions(form.load_packed_module(), contract.PackedFormat)
    (page,) = catalog.formats_of("Page")
    for name in ("content_of", "script_readable", "coded_size", "encode"):
        assert hasattr(contract.PageFormat, name)
        assert callable(getattr(page.load_page_module(), name))
    require_functions(catalog.load_compression(), contract.CompressionFormat)
    require_functions(catalog.load_photographs(), contract.PhotographFormat)
    require_functions(catalog.load_checkpoints(), contract.CheckpointFormat)
