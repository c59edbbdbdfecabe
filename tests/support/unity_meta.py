"""The `.meta` files of the Unity package. `python -m tests.support.unity_meta` writes the missing ones.

Unity identifies an asset by the GUID in its `.meta` file. Shared scenes refer to scripts and shaders by these GUIDs,
so they must be the same on every machine and must never change: a GUID is the MD5 of the package's name and the path.
If you rename a file, keep its `.meta` file, and add the new path to RENAMED with the path that the GUID was made from.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from tests.support.csharp import PACKAGE

NAME = "com.nerfbake.unity"
RENAMED: dict[str, str] = {}  # current path: path that its GUID was made from
_IMPORTERS = {
    "": ["DefaultImporter:", "  externalObjects: {}"],
    ".cs": [
        "MonoImporter:",
        "  externalObjects: {}",
        "  serializedVersion: 2",
        "  defaultReferences: []",
        "  executionOrder: 0",
        "  icon: {instanceID: 0}",
    ],
    ".shader": ["ShaderImporter:", "  externalObjects: {}", "  defaultTextures: []", "  nonModifiableTextures: []"],
    ".hlsl": ["ShaderIncludeImporter:", "  externalObjects: {}"],
    ".asmdef": ["AssemblyDefinitionImporter:", "  externalObjects: {}"],
    ".json": ["PackageManifestImporter:", "  externalObjects: {}"],
    ".md": ["TextScriptImporter:", "  externalObjects: {}"],
}


def imported() -> list[Path]:
    """Every file and folder that Unity imports from the package, or from a sample that is copied into a project.

    Inside the package, Unity skips folders whose name ends with ~.
    """
    paths = (path for path in sorted(PACKAGE.rglob("*")) if path.suffix != ".meta")
    return [path for path in paths if not path.name.startswith(".") and not path.name.endswith("~")]


def meta_of(path: Path) -> Path:
    return path.with_name(path.name + ".meta")


def meta_text(path: Path) -> str:
    inside = path.relative_to(PACKAGE).as_posix()
    guid = hashlib.md5(f"{NAME}/{RENAMED.get(inside, inside)}".encode(), usedforsecurity=False).hexdigest()
    lines = ["fileFormatVersion: 2", f"guid: {guid}"]
    if path.is_dir():
        lines.append("folderAsset: yes")
    lines += _IMPORTERS["" if path.is_dir() else path.suffix]
    lines += ["  userData:", "  assetBundleName:", "  assetBundleVariant:"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for path in imported():
        if not meta_of(path).exists():
            meta_of(path).write_text(meta_text(path))
