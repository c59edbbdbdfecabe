"""Sources and targets of jobs: files, folders and streams. They report each step, and their names appear in errors.

Jobs accept a path wherever they accept a Source or a Target. A Target also has the format, and whether an existing file
may be replaced.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nerfbake import catalog, io, memory
from nerfbake.errors import NerfbakeError, UsageError
from nerfbake.installation import is_installed
from nerfbake.jobs.steps import Steps, Tell

if TYPE_CHECKING:
    from nerfbake.scene.stage1 import Stage1


class Source(NamedTuple):
    """A file or folder to read, or '-' for stdin."""

    path: str

    @property
    def name(self) -> str:
        """The name in messages and errors."""
        return io.reading_name(self.path)

    def read(self, steps: Steps, *kinds: type) -> Any:
        """Read and return a scene of one of these types. Raises NerfbakeError."""
        return self.read_with_format(steps, *kinds).scene

    def read_with_format(self, steps: Steps, *kinds: type) -> io.Loaded[Any]:
        """Read the scene with its format, size in bytes (of a stream: the bytes read) and packing.

        Prints what of the file is left out, and what was assumed.
        """
        with steps.phase(f"reading {self.name}"):
            found: io.Loaded[Any] = io.load_with_format(self.path, *kinds)
        for note in _notes(found.scene):
            steps.say(f"{self.name}: {note}")
        return found

    @contextmanager
    def blamed(self, steps: Steps, phase: str) -> Iterator[Tell]:
        """Run a block as a step of the work. Its errors name this file."""
        with steps.phase(phase) as tell, io.blame(self.name):
            yield tell


def _notes(scene: Any) -> Iterator[str]:
    """Yield a line for each part of a file that its scene lacks, and for each assumption."""
    yield from getattr(scene, "notes", ())
    yield from getattr(scene, "pose_notes", ())  # cameras
    if getattr(scene, "dropped", 0):  # splats
        yield scene.unread_problems()[0].found


class Stage1Source(NamedTuple):
    """A stage-1 folder of nerf2mesh, or feature textures and an MLP from other files.

    folder      the folder; '' if `features` and `mlp` replace it
    features    a texture for each cascade
    mlp         the mlp.json for these textures
    transforms  a transforms.json with the training cameras, in the mesh's world coordinates; None: that of the folder
    """

    folder: str = ""
    features: tuple[str, ...] = ()
    mlp: str | None = None
    transforms: str | None = None

    @property
    def name(self) -> str:
        """The name in messages and errors."""
        return self.folder or ", ".join(self.features)

    @property
    def inputs(self) -> tuple[str | None, ...]:
        """The paths that are read."""
        return (self.folder, *self.features, self.mlp, self.transforms)

    def read(self, steps: Steps) -> Stage1:
        named = {"transforms.json": self.transforms, "mlp.json": self.mlp}
        named |= {f"feat1_{c}{Path(path).suffix.lower()}": path for c, path in enumerate(self.features)}
        given = {name: path for name, path in named.items() if path is not None}
        from nerfbake.scene.stage1 import Stage1

        # The scene counts the parts of these files that it keeps.
        with self.blamed(steps, f"reading {self.name}"), memory.scope():
            files = io.load_files(given)
            if self.folder:
                return io.load_folder(self.folder, Stage1, more=files)
            return io.decode_files(files, Stage1)

    @contextmanager
    def blamed(self, steps: Steps, phase: str) -> Iterator[None]:
        """Run a block as a step of the work. Its errors name this input."""
        with steps.phase(phase), io.blame(self.name):
            yield


class Target(NamedTuple):
    """A file to write, or '-' for stdout.

    to          the format; None: the format of the path's extension
    force       replace an existing file
    profile     of an octree's format: the encoding of arrays; None: the default of the format
    voxel_type  of an octree's format: declare the type of a number or of a whole voxel; None: of a number
    """

    path: str
    to: str | None = None
    force: bool = False
    profile: str | None = None
    voxel_type: str | None = None

    @property
    def name(self) -> str:
        """The name in messages."""
        return "stdout" if self.path == io.STREAM else self.path

    @property
    def ending(self) -> str:
        """What selects the format: the path, or the extension that `to` stands for."""
        return self.path if self.to is None else f".{self.to.removeprefix('.')}"

    def folder(self, scene: str) -> FolderTarget | None:
        """Return the folder that is written if the path is that of its key, which identifies its kind; else None."""
        kind = catalog.folder_of_key(self.path) if self.to is None else None
        return FolderTarget(str(Path(self.path).parent), self.force) if kind and kind.scene == scene else None

    def require(self, scene: str, **options: Any) -> catalog.Format:
        """Return the format to write. Call it before doing any work. Options that are None count as not given.

        Raises NerfbakeError if a scene of this type cannot be written to this target with these options.
        """
        form = io.format_for(self.path, scene, to=self.to)
        form.require_options(self._given(options))
        for path in (self.path, *io.paths_beside(self.path, form, to=self.to)):
            io.require_absent(path, force=self.force)
        return form

    def require_measurable(self, reason: str) -> None:
        """Raise UsageError for an output that cannot be read back: stdout, a pipe or a device.

        reason: why it is read back. Call it before doing any work.
        """
        if self.path == io.STREAM:
            raise UsageError(f"{reason}; allowed: an OUT other than '-'")
        if io.is_pipe_or_device(self.path):
            raise UsageError(f"{self.path} is a pipe or a device, but {reason}; allowed: a regular file")

    def require_read_back(self, command: str) -> None:
        """Raise UsageError for an output that this command cannot read back to measure it."""
        self.require_measurable(f"{command} measures the file that it wrote")

    def write(self, steps: Steps, scene: Any, **options: Any) -> None:
        """Write a scene. Options are passed to the format, except those that are None."""
        with self.writing(steps, scene, **options):
            pass

    @contextmanager
    def writing(self, steps: Steps, scene: Any, **options: Any) -> Iterator[io.PendingFile]:
        """Like write(), with a block that runs before the file gets its final name; see io.saving()."""
        saving = io.saving(self.path, scene, to=self.to, force=self.force, **self._given(options))
        with _written(steps, self.path, saving) as saved:
            steps.say(f"{self.name}: {scene}, {saved.size:,} bytes")
            del scene  # the block may need its memory
            yield saved

    def _given(self, options: dict[str, Any]) -> dict[str, Any]:
        own = {"profile": self.profile, "voxel_type": self.voxel_type}
        return {name: value for name, value in {**own, **options}.items() if value is not None}


def axis_option(form: catalog.AnyFormat | catalog.Dialect, in_up: str | None) -> dict[str, Any]:
    """Return the option `up` of a format for the up axis of what is read; none if that is None.

    Raises UsageError if the format has no such option.
    """
    if in_up is None:
        return {}
    if not isinstance(form, catalog.Format) or not form.choices("up"):
        named = form.suffix if isinstance(form, catalog.Format) else form.name
        allowed = ", ".join(each.suffix for each in catalog.formats_of(form.scene) if each.choices("up"))
        raise UsageError(f"`in_up` has no effect on {named}; allowed: with {allowed}")
    return {"up": in_up}


class FolderTarget(NamedTuple):
    """A folder to write. force: replace an existing folder of the same kind that contains nothing else."""

    path: str
    force: bool = False

    def require(self, contents: io.FolderContents | str, inputs: Sequence[str | None] = ()) -> None:
        """Raise UsageError for '-', OutputError if the folder cannot be written. Call it before doing any work.

        contents: those of the folder, or the type of the scene that is written. inputs: the paths that are read; None
        and '' are ignored. A folder that contains one of them is not replaced.
        """
        if self.path == io.STREAM:
            raise UsageError("stdout takes one file; allowed: a folder")
        if isinstance(contents, str):
            contents = io.FolderContents.of(catalog.folder_to_write(contents))
        given = [path for path in inputs if path]
        io.require_no_folder(self.path, contents, force=self.force, inputs=given)

    def write(self, steps: Steps, scene: Any, **options: Any) -> dict[str, int]:
        """Write a scene and return the size in bytes of each file. Options are passed to the format's encode()."""
        with self.writing(steps, scene, **options) as saved:
            return saved.sizes

    @contextmanager
    def writing(self, steps: Steps, scene: Any, **options: Any) -> Iterator[io.PendingFile]:
        """Like write(), with a block that runs before the folder gets its final name; see io.saving_folder()."""
        with _written(steps, self.path, io.saving_folder(self.path, scene, force=self.force, **options)) as saved:
            yield saved


@contextmanager
def read_back_as(name: str) -> Iterator[None]:
    """Run a block that reads an output before it has its final name: errors have this name, not the temporary one."""
    try:
        yield
    except NerfbakeError as error:
        error.source = name
        raise


def read_back(target: Target, path: str, scene: Any, **options: Any) -> Any:
    """Return the scene in an output at a temporary path, to measure it. Raises NerfbakeError naming the target.

    scene, options: what was written, and how. If the library that reads the format is not installed, the result is
    what it would read.
    """
    form = io.format_for(target.path, type(scene).__name__, to=target.to)
    if form.library and not is_installed(form.library):
        return form.load_stored_module().stored(scene, **options)
    with read_back_as(target.path):
        return io.load(path, type(scene))


@contextmanager
def _written(steps: Steps, path: str, saving: AbstractContextManager[io.PendingFile]) -> Iterator[io.PendingFile]:
    """Yield what `saving` yields. The phase ends before the block runs, when everything is on the disk."""
    with ExitStack() as stack:
        with steps.phase(f"writing {path}"):
            saved = stack.enter_context(saving)
        yield saved


AnySource = Source | str | Path
AnyTarget = Target | str | Path


def as_source(source: AnySource) -> Source:
    """Return a path as a Source, and a Source unchanged."""
    return source if isinstance(source, Source) else Source(str(source))


def as_target(target: AnyTarget) -> Target:
    """Return a path as a Target whose extension selects the format, and a Target unchanged."""
    return target if isinstance(target, Target) else Target(str(target))
