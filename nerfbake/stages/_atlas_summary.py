"""What there is to know about nerf2mesh's stage 1 and about the atlases that stand for its MLP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfbake.kernels.cluster import colours
from nerfbake.scene.atlas import BakedAtlas, OctahedralAtlas
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.specular import SpecularField
from nerfbake.scene.stage1 import Stage1


def summary_of_stage1(stage1: Stage1) -> dict[str, Any]:
    """Each cascade's textures, MLP and mesh, and how many cameras there are."""
    parts = zip(stage1.fields, stage1.meshes, strict=True)
    return {
        "kind": "nerf2mesh stage 1",
        "cameras": None if stage1.cameras is None else len(stage1.cameras),
        "cascades": {str(c): {**_of_field(field), **_of_mesh(mesh)} for c, (field, mesh) in enumerate(parts)},
    }


def summary_of_atlas(baked: BakedAtlas) -> dict[str, Any]:
    """Each cascade's maps, labels and mesh, with the errors and the options that its atlas.json tells."""
    errors = baked.facts.get("errors")
    parts = zip(baked.atlases, baked.meshes, strict=True)
    return {
        "kind": "octahedral atlas",
        "bake": _told(baked.facts.get("bake")),
        "cascades": {
            str(c): {
                **_of_atlas(atlas),
                **_of_mesh(mesh),
                "errors": _told(errors[c] if isinstance(errors, list) and c < len(errors) else None),
            }
            for c, (atlas, mesh) in enumerate(parts)
        },
    }


def _of_field(field: SpecularField) -> dict[str, Any]:
    H, W, _ = field.features.shape
    return {
        "texture": [W, H],
        "texels_used": int(np.count_nonzero(field.used)),
        "colours": len(np.unique(colours.codes_of(field.features[field.used]))),
        "hidden_units": int(field.w0.shape[1]),
    }


def _of_atlas(atlas: OctahedralAtlas) -> dict[str, Any]:
    H, W = atlas.labels.shape
    return {
        "method": atlas.method,
        "clusters": atlas.K,
        "maps": len(atlas.tiles),
        "map_size": atlas.R,
        "border": atlas.border,
        "texture": [W, H],
        "labels_used": len(np.unique(atlas.labels)),
    }


def _of_mesh(mesh: Mesh | None) -> dict[str, Any]:
    diffuse = None if mesh is None or mesh.texture is None else list(mesh.texture.shape[1::-1])
    return {"triangles": None if mesh is None else len(mesh.faces), "diffuse": diffuse}


def _told(facts: Any) -> dict[str, Any] | None:
    """The numbers and short words of an object that a file may have made up."""
    if not isinstance(facts, Mapping):
        return None
    return {
        key: value
        for key, value in facts.items()
        if len(key) <= 40 and (isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= 40))
    }
