"""All files of the set by their names."""

from __future__ import annotations

from tests.conformance.case import HOME as ALL
from tests.conformance.case import text_of
from tests.conformance.gaussian_splatting.expected import numbers_of, picture_of, png_of
from tests.conformance.gaussian_splatting.invalid import invalid
from tests.conformance.gaussian_splatting.scenes import scenes

HOME = ALL / "khr_gaussian_splatting"


def all_files() -> dict[str, bytes]:
    """By path below HOME, without README.md."""
    found: dict[str, bytes] = {}
    for scene in scenes():
        found[f"valid/{scene.name}.glb"] = scene.data
        found[f"valid/{scene.name}.json"] = (text_of(numbers_of(scene)) + "\n").encode()
        found[f"valid/{scene.name}.png"] = png_of(picture_of(scene))
    findings = {}
    for each in invalid():
        found[f"invalid/{each.name}.glb"] = each.data
        findings[f"{each.name}.glb"] = {"place": each.place, "found": each.found, "allowed": each.allowed}
    found["invalid/findings.json"] = (text_of(findings) + "\n").encode()
    return found
