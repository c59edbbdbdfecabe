"""Read checkpoints of nerfstudio: `nerfstudio_models/step-000029999.ckpt` of a run, which torch writes.

The model's state is in `pipeline`, with keys such as `_model.field.aabb`. The optimisers' state, two more copies of all
numbers, is never read. A checkpoint in its run's folder takes the run's files along. Source: docs/fields.md,
"Programs".
"""

from __future__ import annotations

from dataclasses import replace

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.kplanes import KPLANES, field_of_kplanes
from nerfbake.formats.field.nerfacto import field_of_instant_ngp, field_of_nerfacto, is_instant_ngp, is_nerfacto
from nerfbake.formats.field.run_files import Run, RunFolder, read_run
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.field.vanilla_nerf import VANILLA, field_of_vanilla_nerf, refuse_relatives
from nerfbake.formats.wire.torch import mentions
from nerfbake.scene.function_field import FunctionField

_KNOWN = "nerfacto, instant-ngp, vanilla-nerf, K-Planes"


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with the state of a nerfstudio pipeline."""
    return mentions(view, b"pipeline", b"_model.")


def decode(view: memoryview, *, beside: RunFolder | None = None) -> FunctionField:
    """Return the field of a checkpoint. beside: the files of its folder."""
    return field_of(view, read_run(beside))


def field_of(view: memoryview, run: Run) -> FunctionField:
    """Return the field of a checkpoint of this run. Raises InvalidFile, MemoryLimit."""
    model = NerfstudioModel(view)
    if is_instant_ngp(model):
        return field_of_instant_ngp(model, run)
    if is_nerfacto(model):
        return field_of_nerfacto(model, run)
    if KPLANES in model.state:
        return field_of_kplanes(model, run)
    if VANILLA in model.state:
        return _vanilla_nerf(model, run)
    refuse_relatives(model)
    there = ", ".join(dict.fromkeys(str(key).rpartition(".")[0] for key in model.state))
    raise InvalidFile(Problem("pipeline", f"holds a model that is not known ({there:.100})", _KNOWN))


def _vanilla_nerf(model: TorchModel, run: Run) -> FunctionField:
    near, far = run.collider(2.0, 6.0)
    found = field_of_vanilla_nerf(model, run.frame, near=near, far=far)
    notes = (*run.notes, *found.notes)
    return replace(found, background=run.background("white"), cameras=run.cameras, notes=notes)


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
