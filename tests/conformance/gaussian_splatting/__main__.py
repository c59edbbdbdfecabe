"""Write the set anew. Says nothing if it is as it was."""

from __future__ import annotations

from tests.conformance.gaussian_splatting.files import HOME, all_files

for name, data in all_files().items():
    path = HOME / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_bytes() != data:
        path.write_bytes(data)
        print(name)
