"""Read checkpoints of nerfstudio: `nerfstudio_models/step-000029999.ckpt` of a run, which torch writes.

The model's state is in `pipeline`, with keys such as `_model.field.aabb`. The optimisers' state, two more copies of all
numbers, is never read. Source: docs/fields.md, "nerfstudio".
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.nerfacto import field_of_nerfacto
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.field.vanilla_nerf import VANILLA, field_of_vanilla_nerf, refuse_relatives
from nerfbake.formats.wire.torch import mentions
from nerfbake.scene.function_field import FunctionField


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with the state of a nerfstudio pipeline."""
    return mentions(view, b"pipeline", b"_model.")


def decode(view: memoryview) -> FunctionField:
    """Return the field of a checkpoint."""
    model = NerfstudioModel(view)
    if "field.mlp_base.model.0.hash_table" in model.state:
        return field_of_nerfacto(model, np.eye(3, 4))
    if VANILLA in model.state:
        return field_of_vanilla_nerf(model, np.eye(3, 4))
    refuse_relatives(model)
    raise InvalidFile(Problem("pipeline", "holds no model that is known", "nerfacto, vanilla-nerf"))


class NerfstudioModel(TorchModel):
    """A checkpoint, with the arrays of its model by keys without `_model.`."""

    def __init__(self, view: memoryview) -> None:
        super().__init__(view, "pipeline", "pipeline", "nerfstudio")
        prefixes = ("_model.module.", "_model.")  # the first after training on several GPUs
        state = {}
        for key, value in self.state.items():
            prefix = next((each for each in prefixes if isinstance(key, str) and key.startswith(each)), None)
            if prefix is not None:
                state[key.removeprefix(prefix)] = value
        self.state = state
