"""Fields that are functions, as other programs write them: the files are made here, after their formats."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import FunctionField, catalog, load
from tests.conformance.case import Case, Facts, Frozen, form_named
from tests.support import nerfs, nerfstudio, snapshots, torch_ngp

DIRECTION = [2 / 7, -3 / 7, 6 / 7]
POINTS = np.random.default_rng(11).uniform(-0.7, 0.7, (6, 3)).round(3)
Values = Callable[[Any, Any], tuple[Any, Any]]


def cases() -> Iterator[Case]:
    about = "A checkpoint of nerfacto as nerfstudio writes it with tiny-cuda-nn, without the files of its run."
    root = nerfstudio.nerfacto("tcnn", log2=4)
    files = {"function/nerfacto.ckpt": Frozen(form_named("ckpt"), None, data=nerfstudio.nerfstudio_file(root))}
    yield Case("function/nerfacto", about, files, _facts(_nerfacto(root, 0.01), np.eye(3, 4)), answer, computed=1e-4)
    about = "A run of nerfacto: the same layout of torch, with config.yml and dataparser_transforms.json."
    root = nerfstudio.nerfacto("torch", log2=4)
    data = nerfstudio.run_files(root, average_init_density=0.5)
    world = 0.5 * np.array([[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, -0.25]])
    files = {"function/nerfacto_run": Frozen(form_named("nerfstudio"), None, data=data)}
    yield Case("function/nerfacto_run", about, files, _facts(_nerfacto(root, 0.5), world), answer, computed=1e-4)
    about = "A snapshot as instant-ngp writes it: MessagePack, bare and in gzip that does not compress."
    snapshot = snapshots.snapshot_file(snapshots.snapshot(grid=[]))
    world = np.column_stack([snapshots.SCALE * np.eye(3), snapshots.OFFSET])[[1, 2, 0]]
    files = {
        "function/snapshot.msgpack": Frozen(_form("msgpack", "instant_ngp"), None, data=snapshot),
        "function/snapshot.ingp": Frozen(form_named("ingp"), None, data=gzip.compress(snapshot, 0, mtime=0)),
    }
    yield Case("function/snapshot", about, files, _facts(snapshots.reference, world), answer, computed=1e-4)
    about = "A checkpoint as torch-ngp writes it with torch; its world is 0.33 times the cameras'."
    small = torch_ngp.torch_ngp(1.0, log2=4)
    whole = torch_ngp.torch_ngp_file(small)
    facts = _facts(lambda q, d: torch_ngp.reference(small, q, d, 1.0), 0.33 * np.eye(3, 4)[[1, 2, 0]])
    files = {"function/torch_ngp.pth": Frozen(_form("pth", "torch_ngp"), None, data=whole)}
    yield Case("function/torch_ngp", about, files, facts, answer, computed=1e-4)
    yield from _nerfs()


def _nerfs() -> Iterator[Case]:
    """Networks without tables, whose trained coordinates are the world's."""
    about = "A checkpoint as nerf-pytorch writes it with torch: a coarse network, and the fine one, which is used."
    layers = nerfs.nerf_pytorch(1)
    data = nerfs.nerf_pytorch_file(layers)
    files = {"function/nerf_pytorch.tar": Frozen(_form("tar", "nerf_pytorch"), None, data=data)}
    facts = _facts(partial(nerfs.nerf_pytorch_answers, layers), np.eye(3, 4))
    yield Case("function/nerf_pytorch", about, files, facts, answer, computed=1e-5)
    about = "A fine-tuned checkpoint as KiloNeRF writes it with torch, and the YAML file with its domain and cells."
    layers = nerfs.kilonerf(3)
    beside = {"kilonerf.yaml": nerfs.KILONERF_YAML.encode()}
    data = nerfs.kilonerf_file(layers)
    files = {"function/kilonerf.pth": Frozen(_form("pth", "kilonerf"), None, data=data, beside=beside)}
    low, high = nerfs.DOMAIN
    points = (low + (POINTS / 1.5 + 0.5) * (high - low)).round(3)
    facts = _facts(partial(nerfs.kilonerf_answers, layers), np.eye(3, 4), points)
    yield Case("function/kilonerf", about, files, facts, answer, computed=1e-5)
    about = "A checkpoint as JaxNeRF writes it with flax: MessagePack with a coarse network, and the fine one."
    parameters = nerfs.jaxnerf(3)
    data = nerfs.jaxnerf_file(parameters)
    files = {"function/jaxnerf.msgpack": Frozen(_form("msgpack", "jaxnerf"), None, data=data)}
    facts = _facts(partial(nerfs.jaxnerf_answers, parameters), np.eye(3, 4))
    yield Case("function/jaxnerf", about, files, facts, answer, computed=1e-5)


def _form(name: str, module: str) -> catalog.Format:
    """The format of this name, which another program has, too."""
    return next(form for form in catalog.FORMATS if (form.name, form.module) == (name, f"field.{module}"))


def _nerfacto(root: dict[str, Any], density: float) -> Values:
    layout = "tcnn" if "_model.field.mlp_head.tcnn_encoding.params" in root["pipeline"] else "torch"
    mean = root["pipeline"]["_model.field.embedding_appearance.embedding.weight"].mean(axis=0)

    def values(q: Any, d: Any) -> tuple[Any, Any]:
        found, colours = nerfstudio.reference(layout, root, nerfstudio.contracted(q), d, mean)
        return density * found, colours

    return values


def _facts(values: Values, frame: Any, points: Any = POINTS) -> Facts:
    """By the formulas in tests.support, in the trained coordinates; frame (3, 4): from the world to these."""
    scale = np.linalg.norm(frame[:, 0])
    turned = np.tile(frame[:, :3] @ DIRECTION / scale, (len(points), 1))
    density, colours = values(points @ frame[:, :3].T + frame[:, 3], turned)
    lookups = [
        {"point": point, "density": sigma, "colour": colour}
        for point, sigma, colour in zip(points.tolist(), (scale * density).tolist(), colours.tolist(), strict=True)
    ]
    return {"frame": frame.tolist(), "direction": DIRECTION, "lookups": lookups}


def answer(path: Path, expected: Facts) -> Facts:
    field = load(path, FunctionField)
    density, features = field.density(np.array([each["point"] for each in expected["lookups"]]))
    colours = field.colour(features, np.tile(expected["direction"], (len(density), 1)))
    lookups = [
        {"point": each["point"], "density": sigma, "colour": colour}
        for each, sigma, colour in zip(expected["lookups"], density.tolist(), colours.tolist(), strict=True)
    ]
    return {"frame": field.frame.tolist(), "direction": expected["direction"], "lookups": lookups}
