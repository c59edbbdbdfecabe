"""Pictures that are compressed in memory: a fit keeps hundreds of them, and reads one at a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np
import numpy.typing as npt

from nerfbake import memory

Pixels = npt.NDArray[np.uint8]
_LEVEL = 1  # of zstd: pictures of 800x800 pixels with alpha shrink to an eighth in 3 ms each, photographs to 0.4


class PackedPicture:
    """A compressed picture. `form`: its shape and dtype. Raises MemoryLimit."""

    def __init__(self, pixels: Pixels) -> None:
        import zstandard  # here, because most commands read no pictures

        self.form = pixels.shape, pixels.dtype
        # compress() would allocate as many bytes as the pixels have. What it leaves of them between two pictures is too
        # short for the pixels of the next one, and stays unused.
        packer = zstandard.ZstdCompressor(level=_LEVEL).compressobj(size=pixels.nbytes)
        self._data = packer.compress(np.ascontiguousarray(pixels).data) + packer.flush()
        memory.grown(self, "a compressed picture", len(self._data))

    def pixels(self) -> Pixels:
        """Return the pixels, read-only."""
        import zstandard

        shape, dtype = self.form
        return np.frombuffer(zstandard.ZstdDecompressor().decompress(self._data), dtype).reshape(shape)


class PackedPictures(Sequence[Pixels]):
    """A sequence of pictures, each of which is decompressed at every access. They are read-only.

    >>> import numpy as np
    >>> from nerfbake.scene.packed_pictures import PackedPictures
    >>> pictures = PackedPictures.of([np.full((3, 4, 4), 255, np.uint8)])
    >>> len(pictures), pictures[0].shape, int(pictures[0].min())
    (1, (3, 4, 4), 255)
    """

    def __init__(self, packed: Iterable[PackedPicture]) -> None:
        self.packed = tuple(packed)

    @staticmethod
    def of(pictures: Sequence[Pixels]) -> PackedPictures:
        """Compress pictures, unless they are compressed. Raises MemoryLimit."""
        return pictures if isinstance(pictures, PackedPictures) else PackedPictures(map(PackedPicture, pictures))

    def __len__(self) -> int:
        return len(self.packed)

    @overload
    def __getitem__(self, number: int) -> Pixels: ...
    @overload
    def __getitem__(self, number: slice) -> PackedPictures: ...
    def __getitem__(self, number: int | slice) -> Pixels | PackedPictures:
        return PackedPictures(self.packed[number]) if isinstance(number, slice) else self.packed[number].pixels()

    def take(self, numbers: Iterable[int]) -> PackedPictures:
        """Return these pictures, in this order. They are shared, not copied."""
        return PackedPictures(self.packed[number] for number in numbers)
