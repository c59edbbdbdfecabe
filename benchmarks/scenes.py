"""The scenes of the benchmarks: paths of the real scenes, and samples, which are created once."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerfbake import sample_n3tree, save

DATA = Path(os.environ.get("NERFBAKE_DATA", Path(__file__).parents[2] / "shared" / "data"))


class Sample(NamedTuple):
    """A sample tree. deflated: compressed, as svox writes its trees."""

    resolution: int
    basis: str = "SH9"
    seed: int = 0
    deflated: bool = False


SAMPLES = {
    # Of the seeds 0 to 9, this one gives the number of nodes nearest to LEGO in TR-24-01: 484,000 for 420,000.
    "sample SH16": Sample(256, "SH16", seed=2),
    "sample_sh16": Sample(256, "SH16", deflated=True),
    "sample_128": Sample(128),
    "sample_256": Sample(256),
    "sample_512": Sample(512),
}


@dataclass(frozen=True)
class Scenes:
    """data: the folder of the real scenes. folder: the folder for samples and other intermediate files."""

    data: Path
    folder: Path

    @property
    def chairs(self) -> Path:
        """The folder with the PlenOctrees of the real chair."""
        return self.data / "plenoctree" / "chair"

    @property
    def chair(self) -> Path:
        """The chair as a PlenOctree of 256^3."""
        return self.chairs / "chair_sh9.npz"

    @property
    def views(self) -> Path:
        """The folder with five held-out views of the chair: transforms.json, and a photograph for each view."""
        return self.chairs / "views"

    @property
    def test_cameras(self) -> Path:
        """The cameras of the chair's 25 test views."""
        return self.data / "nerf_synthetic" / "chair" / "transforms_test.json"

    @property
    def capture(self) -> Path:
        """The folder with the chair's photographs, 100 for fitting and 25 held out."""
        return self.data / "nerf_synthetic" / "chair"

    @property
    def nerf_synthetic(self) -> Path:
        """The folder with scenes of NeRF-Synthetic as downloaded: 800x800, 100 training views and 200 test views."""
        return self.data / "nerf_synthetic_800"

    @property
    def captures(self) -> Path:
        """The folder with captures as people take them: plush, photographs of a phone; mug, with masks."""
        return self.data / "captures"

    @property
    def splats(self) -> Path:
        """The folder with files of Gaussian splats."""
        return self.data / "splats"

    @property
    def stage1(self) -> Path:
        """nerf2mesh's real texture and MLP."""
        return self.data / "nerf2mesh" / "mesh_stage1"

    def sample(self, name: str) -> Path:
        """Return the file of one of SAMPLES, and create it on the first call."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            resolution, basis, seed, deflated = SAMPLES[name]
            save(path, sample_n3tree(resolution=resolution, basis=basis, seed=seed))
            if deflated:
                with np.load(path) as stored:
                    arrays = dict(stored)
                np.savez_compressed(path, **arrays)
        return path
