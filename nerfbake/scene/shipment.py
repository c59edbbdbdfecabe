"""The receipt of a shipment: files made of one scene, what each loses, and which programs read it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from nerfbake.scene.base import Scene
from nerfbake.scene.image import Image


class ReadingProgram(NamedTuple):
    """A program that reads a file of this format, or might.

    version  '' if it is not known
    reads    what it makes of the file; '' if that is not known
    known    ran: a file of nerfbake was opened in it; read: its own documentation says so; not run: nobody has tried
    """

    program: str
    version: str
    reads: str
    known: Literal["ran", "read", "not run"]


class Judgement(NamedTuple):
    """How near the pictures of a file come to those of the scene.

    psnr       dB, the mean over the views; 100 if the pictures are equal
    max_error  the largest difference of a channel in any pixel of any view, sRGB in 0..1
    worst      name of the view with the lowest PSNR, and worst_psnr its PSNR in dB
    by         how the file was read
    pictures   of the worst view: the scene, the file, and their difference, amplified
    """

    psnr: float
    max_error: float
    worst: str
    worst_psnr: float
    by: str
    pictures: tuple[Image, Image, Image]


class ShippedFile(NamedTuple):
    """A file of a shipment.

    name      of the file; targets: those that it is for; what: what it holds, in words
    readers   programs that read it
    bytes     its size; 0 if it could not be made
    seconds   to make it, without the shared steps, without compiling kernels and without judging; cpu_seconds: the
              same of all threads
    judged    None: it was not judged
    reason    why it was not judged, or why it could not be made; '' if it was judged
    """

    name: str
    targets: tuple[str, ...]
    what: str
    readers: tuple[ReadingProgram, ...]
    bytes: int
    seconds: float
    cpu_seconds: float
    judged: Judgement | None
    reason: str

    @property
    def status(self) -> Literal["judged", "not judged", "failed"]:
        """Whether the file is there, and was judged."""
        return "judged" if self.judged else "not judged" if self.bytes else "failed"


class SharedStep(NamedTuple):
    """Work that several files need: what it makes, and its seconds and CPU seconds."""

    what: str
    seconds: float
    cpu_seconds: float


@dataclass(frozen=True, eq=False, repr=False)
class Shipment(Scene):
    """Files made of one scene for several targets.

    name, content  of the scene: its file, and a description
    targets        for whom the files are
    files          in the order of the list of files
    shared         steps whose results several files were made of
    views          the views that the files were judged on, in words

    >>> from nerfbake import Shipment
    >>> print(Shipment("a.npz", "a PlenOctree", ("unity",), (), (), "8 views"))
    0 files of a.npz for unity
    """

    name: str
    content: str
    targets: tuple[str, ...]
    files: tuple[ShippedFile, ...]
    shared: tuple[SharedStep, ...]
    views: str

    @property
    def failed(self) -> tuple[ShippedFile, ...]:
        """The files that could not be made."""
        return tuple(file for file in self.files if file.status == "failed")

    @property
    def facts(self) -> dict[str, Any]:
        """What report.json holds, besides its version."""
        return {
            "in": self.name,
            "content": self.content,
            "for": list(self.targets),
            "views": self.views,
            "shared": [step._asdict() for step in self.shared],
            "files": [_facts(file) for file in self.files],
        }

    def __str__(self) -> str:
        count = len(self.files)
        return f"{count} file{'s' * (count != 1)} of {self.name} for {', '.join(self.targets)}"


def _facts(file: ShippedFile) -> dict[str, Any]:
    judged = file.judged
    made = file.status != "failed"
    return {
        "file": file.name,
        "for": list(file.targets),
        "content": file.what,
        "status": file.status,
        "reason": file.reason or None,
        "bytes": file.bytes if made else None,
        "seconds": file.seconds if made else None,
        "cpu_seconds": file.cpu_seconds if made else None,
        "psnr": judged and judged.psnr,
        "max_error": judged and judged.max_error,
        "worst": judged and {"view": judged.worst, "psnr": judged.worst_psnr},
        "judged_by": judged and judged.by,
        "readers": [
            {**each._asdict(), "version": each.version or None, "reads": each.reads or None} for each in file.readers
        ],
    }
