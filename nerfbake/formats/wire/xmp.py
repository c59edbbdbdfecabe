"""Read XMP packets: what cameras and stitchers say of a photograph, beside its EXIF data.

A property is an attribute of an element, or an element with a text. Its namespace is left out.
Source: ISO 16684-1; Google's "Photo Sphere XMP metadata" for GPano.
"""

from __future__ import annotations

from contextlib import suppress

from nerfbake.errors import InvalidFile
from nerfbake.formats.wire.xml import parse_xml


def properties_of(packet: bytes) -> dict[str, str]:
    """Return the properties by name; none for a packet that is damaged."""
    found: dict[str, str] = {}
    with suppress(InvalidFile):
        waiting = [parse_xml(packet.strip(b"\0"), "the XMP packet")]
        while waiting:
            element = waiting.pop()
            found |= element.attributes
            if element.text.strip():
                found[element.name] = element.text.strip()
            waiting += element.children
    return found


def is_all_round(properties: dict[str, str]) -> bool:
    """Whether a picture shows all directions: an equirectangular one from which nothing was cut off."""
    cut = any(
        properties.get(f"CroppedAreaImage{edge}Pixels", whole) != whole
        for edge in ("Width", "Height")
        if (whole := properties.get(f"FullPano{edge}Pixels")) is not None
    )
    return properties.get("ProjectionType") == "equirectangular" and not cut
