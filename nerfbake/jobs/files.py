"""What jobs read and write: files, folders and streams that tell each step, and are blamed for what is wrong in them.

A job takes a path wherever it takes a Source or a Target; a Target says more than a path does: the format, and whether
a file that exists may be replaced.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import nerfbake
from nerfbake import catalog, io, memory
from nerfbake.jobs.steps import Steps, Tell


class Source(NamedTuple):
    """A file or a folder to read, or '-' for stdin."""

    path: str

    @property
    def name(self) -> str:
        """What words and errors call it."""
        return io.reading_name(self.path)

    def read(self, steps: Steps, *kinds: type) -> Any:
        """The scene, of one of these types. Raises NerfbakeError."""
        return self.read_with_format(steps, *kinds).scene

    def read_with_format(self, steps: Steps, *kinds: type) -> io.Loaded[Any]:
        """The scene, its file's format, its size in bytes (of a stream: of what was read) and how it is packed."""
        with steps.phase(f"reading {self.name}"):
            return io.load_with_format(self.path, *kinds)

    @contextmanager
    def blamed(self, steps: Steps, phase: str) -> Iterator[Tell]:
        """A step of the work whose errors are this file's."""
        with steps.phase(phase) as tell, io.blame(self.name):
            yield tell


class Stage1Source(NamedTuple):
    """A stage-1 folder of nerf2mesh, or feature textures and an MLP from anywhere.

    folder      '' where `features` and `mlp` stand in for it
    features    a texture for each cascade
    mlp         their mlp.json
    transforms  where the training cameras stood, in the mesh's own world; None: as the folder has it
    """

    folder: str = ""
    features: tuple[str, ...] = ()
    mlp: str | None = None
    transforms: str | None = None

    @property
    def name(self) -> str:
        """What words and errors call it."""
        return self.folder or ", ".join(self.features)

    def read(self, steps: Steps) -> nerfbake.Stage1:
        named = {"transforms.json": self.transforms, "mlp.json": self.mlp}
        named |= {f"feat1_{c}{Path(path).suffix.lower()}": path for c, path in enumerate(self.features)}
        given = {name: path for name, path in named.items() if path is not None}
        # What the scene keeps of these files is counted with it.
        with self.blamed(steps, f"reading {self.name}"), memory.scope():
            files = io.load_files(given)
            if self.folder:
                return io.load_folder(self.folder, nerfbake.Stage1, more=files)
            return io.decode_files(files, nerfbake.Stage1)

    @contextmanager
    def blamed(self, steps: Steps, phase: str) -> Iterator[None]:
        """A step of the work whose errors are this input's."""
        with steps.phase(phase), io.blame(self.name):
            yield


class Target(NamedTuple):
    """A file to write, or '-' for stdout.

    to       the format; None: the one that the path's ending names
    force    replace a file that exists
    profile  of an octree's format: how it spells arrays; None: as is usual for the format
    voxel_type  of an octree's format: whether it names the type of a number or that of a voxel; None: a number's
    """

    path: str
    to: str | None = None
    force: bool = False
    profile: str | None = None
    voxel_type: str | None = None

    def require(self, scene: str, **options: Any) -> catalog.Format:
        """The format to write; an option of it that is None was not given.

        Raises, before any work is done, if a scene of this type could not be written here with these options.
        """
        form = io.format_for(self.path, scene, to=self.to)
        form.require_options(self._given(options))
        io.require_absent(self.path, force=self.force)
        return form

    def write(self, steps: Steps, scene: Any, **options: Any) -> None:
        """Options go to the format, but for those that are None."""
        with self.writing(steps, scene, **options):
            pass

    @contextmanager
    def writing(self, steps: Steps, scene: Any, **options: Any) -> Iterator[io.Saved]:
        """write(), with a block that judges the file before it takes its name; see io.saving()."""
        saving = io.saving(self.path, scene, to=self.to, force=self.force, **self._given(options))
        with _written(steps, self.path, saving) as saved:
            steps.say(f"{'stdout' if self.path == io.STREAM else self.path}: {scene}, {saved.size:,} bytes")
            yield saved

    def _given(self, options: dict[str, Any]) -> dict[str, Any]:
        own = {"profile": self.profile, "voxel_type": self.voxel_type}
        return {name: value for name, value in {**own, **options}.items() if value is not None}


class FolderTarget(NamedTuple):
    """A folder to write. force: replace one that exists, and all that is in it."""

    path: str
    force: bool = False

    def require(self) -> None:
        """Raises OutputError, before any work is done, if it could not be written."""
        io.require_no_folder(self.path, force=self.force)

    def write(self, steps: Steps, scene: Any, **options: Any) -> dict[str, int]:
        """The size in bytes of each file; options go to the format's encode()."""
        with self.writing(steps, scene, **options) as saved:
            return saved.sizes

    @contextmanager
    def writing(self, steps: Steps, scene: Any, **options: Any) -> Iterator[io.Saved]:
        """Writes a scene, with a block that judges the folder before it takes its name; see io.saving_folder()."""
        with _written(steps, self.path, io.saving_folder(self.path, scene, force=self.force, **options)) as saved:
            yield saved


@contextmanager
def _written(steps: Steps, path: str, saving: AbstractContextManager[io.Saved]) -> Iterator[io.Saved]:
    """The phase ends when everything is on the disk, before the block."""
    with ExitStack() as stack:
        with steps.phase(f"writing {path}"):
            saved = stack.enter_context(saving)
        yield saved


AnySource = Source | str | Path
AnyTarget = Target | str | Path


def as_source(source: AnySource) -> Source:
    """A path as a Source; a Source as it is."""
    return source if isinstance(source, Source) else Source(str(source))


def as_target(target: AnyTarget) -> Target:
    """A path as a Target whose ending names the format; a Target as it is."""
    return target if isinstance(target, Target) else Target(str(target))
