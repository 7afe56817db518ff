"""What people say of a photo, in XMP and IPTC: title, authors, rights, keywords, names of places.

Most of it is true of the panorama as well; Hugin loses what EXIF does not hold too. IPTC-IIM, the older form,
is turned into XMP, which wins where both tell something (Metadata Working Group, 2010). What editors note of
their work, of one photo's pixels (faces, ratings, crops) or of its file is not taken over.
Formats: XMP specification part 1; IPTC-IIM 4.2, and IPTC's table of what it is in XMP.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from hugin_abflow.exif import Packets

Properties = dict[str, Element]  # by {namespace}name

_log = logging.getLogger(__name__)

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_LANG = "{http://www.w3.org/XML/1998/namespace}lang"
_OF_FORM = (_LANG, f"{_RDF}parseType")  # attributes that tell how to read values
DC, XMP = "http://purl.org/dc/elements/1.1/", "http://ns.adobe.com/xap/1.0/"
TIFF, EXIF = "http://ns.adobe.com/tiff/1.0/", "http://ns.adobe.com/exif/1.0/"
_CORE = "http://iptc.org/std/Iptc4xmpCore/1.0/xmlns/"
PHOTOSHOP = "http://ns.adobe.com/photoshop/1.0/"
# Namespaces that are known, by the prefixes with which they are written, and the names that are taken over of
# each; all but these of those that begin with "not".
_KNOWN: tuple[tuple[str, str, str], ...] = (
    ("dc", DC, "contributor coverage creator description language publisher rights subject title"),
    (
        "photoshop",
        PHOTOSHOP,
        "AuthorsPosition CaptionWriter City Country Credit Headline Instructions Source State "
        "TransmissionReference",
    ),
    ("Iptc4xmpCore", _CORE, "not"),
    (
        "Iptc4xmpExt",
        "http://iptc.org/std/Iptc4xmpExt/2008-02-29/",
        "not DigImageGUID DigitalSourceFileType DigitalSourceType ImageRegion MaxAvailHeight MaxAvailWidth",
    ),
    ("xmpRights", "http://ns.adobe.com/xap/1.0/rights/", "not"),
    ("plus", "http://ns.useplus.org/ldf/xmp/1.0/", "not"),
    ("cc", "http://creativecommons.org/ns#", "not"),
    ("lr", "http://ns.adobe.com/lightroom/1.0/", "hierarchicalSubject"),
    ("digiKam", "http://www.digikam.org/ns/1.0/", "TagsList"),
    ("exif", EXIF, ""),
    ("rdf", _RDF[1:-1], ""),
)
_WANTED = {namespace: names.split() for _, namespace, names in _KNOWN}
# What IPTC's second record holds is in XMP; arrays with their kind.
_OF_IPTC: dict[int, tuple[str, str]] = {
    5: (f"{{{DC}}}title", "Alt"),
    25: (f"{{{DC}}}subject", "Bag"),
    40: (f"{{{PHOTOSHOP}}}Instructions", ""),
    80: (f"{{{DC}}}creator", "Seq"),
    85: (f"{{{PHOTOSHOP}}}AuthorsPosition", ""),
    90: (f"{{{PHOTOSHOP}}}City", ""),
    92: (f"{{{_CORE}}}Location", ""),
    95: (f"{{{PHOTOSHOP}}}State", ""),
    100: (f"{{{_CORE}}}CountryCode", ""),
    101: (f"{{{PHOTOSHOP}}}Country", ""),
    103: (f"{{{PHOTOSHOP}}}TransmissionReference", ""),
    105: (f"{{{PHOTOSHOP}}}Headline", ""),
    110: (f"{{{PHOTOSHOP}}}Credit", ""),
    115: (f"{{{PHOTOSHOP}}}Source", ""),
    116: (f"{{{DC}}}rights", "Alt"),
    120: (f"{{{DC}}}description", "Alt"),
    122: (f"{{{PHOTOSHOP}}}CaptionWriter", ""),
}
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_UTF_8 = b"\x1b%G"  # of IPTC's record 1, in data set 90
_MOST = 40_000  # bytes; with GPano it has to fit into a segment of JPEG


def read_caption(photo: Path, packets: Packets) -> Properties:
    """All that XMP and IPTC say of a photo; nothing of what cannot be understood, with a message."""
    found = _of_iptc(packets.iptc)
    if packets.xmp:
        try:
            found |= _of_xmp(packets.xmp)
        except (ElementTree.ParseError, LookupError, ValueError, RecursionError) as error:
            _log.info("%s: its XMP cannot be understood (%s), nothing of it is copied", photo, error)
    return found


def to_copy(found: Properties, place: bool) -> Properties:
    """What is true of the panorama as well.

    place       also where the photo was taken, which is EXIF's to tell.
    """
    return {
        name: element
        for name, element in found.items()
        if _is_wanted(name) or (place and name.startswith(f"{{{EXIF}}}GPS"))
    }


def packed(properties: Mapping[str, Element]) -> str:
    """As a description within an XMP packet; empty if there are none. The longest that are too long are left
    out, with a warning.
    """
    for prefix, namespace, _ in _KNOWN:
        ElementTree.register_namespace(prefix, namespace)
    texts = {name: ElementTree.tostring(element, encoding="unicode") for name, element in properties.items()}
    while sum(len(text.encode()) for text in texts.values()) > _MOST:
        longest = max(texts, key=lambda name: len(texts[name]))
        del texts[longest]
        _log.warning("left out of the panorama, as too long: what the photo's XMP says as %s", longest)
    if not texts:
        return ""
    return "\n".join(['  <rdf:Description rdf:about="">', *(f"   {text}" for text in texts.values()),
                      "  </rdf:Description>"])  # fmt: skip


def plain(element: Element | None) -> str:
    """What a property says, as one text: of languages the default one, of several authors all."""
    if element is None:
        return ""
    items = element.findall(f"*/{_RDF}li")
    if element.find(f"{_RDF}Alt") is not None:
        items = [item for item in items if item.get(_LANG) == "x-default"][:1] or items[:1]
    return "; ".join(said for item in items or [element] if (said := (item.text or "").strip()))


def _is_wanted(name: str) -> bool:
    namespace, _, local = name[1:].partition("}")
    names = _WANTED.get(namespace, [])
    return (local in names) != (names[:1] == ["not"])


def _of_xmp(packet: bytes) -> Properties:
    """The properties of a packet. Raises `ElementTree.ParseError` and others for what is none."""
    content = packet.strip(b"\0 \r\n\t")
    if b"\0" in content:  # nor would the next line find anything in UTF-16
        raise ValueError("it is not in UTF-8")
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError("it defines entities, which XMP does not have")
    found: Properties = {}
    for description in ElementTree.fromstring(content).iter(f"{_RDF}Description"):
        if f"{_RDF}about" not in description.keys() and "about" not in description.keys():  # noqa: SIM118
            continue  # a value within a property
        for name, value in description.items():  # the short form of simple properties
            if name.startswith("{") and not name.startswith(_RDF) and value.strip():
                found[name] = _element(name, [value])
        for element in filter(_tells, description):
            ElementTree.tostring(element)  # what is too deep is found here
            element.tail = None
            found[element.tag] = element
    return found


def _tells(element: Element) -> bool:
    """Whether a property has a value; many programs write titles and authors that have none."""
    told = (value for part in element.iter() for name, value in part.items() if name not in _OF_FORM)
    return any(value.strip() for value in told) or any(value.strip() for value in element.itertext())


def _of_iptc(block: bytes) -> Properties:
    """The properties of an IPTC-IIM block."""
    values: dict[int, list[bytes]] = {}
    is_utf8 = False
    for record, number, value in _data_sets(block):
        if (record, number) == (1, 90):
            is_utf8 = value == _UTF_8
        elif record == 2 and number in _OF_IPTC:
            values.setdefault(number, []).append(value)
    found: Properties = {}
    for number, contents in values.items():
        name, kind = _OF_IPTC[number]
        texts = [said for content in contents if (said := _decoded(content, is_utf8))]
        if texts:
            found[name] = _element(name, texts if kind in ("Bag", "Seq") else texts[:1], kind)
    return found


def _data_sets(block: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Record, number and content of each data set, up to the first that is none."""
    at = 0
    while at + 5 <= len(block) and block[at] == 0x1C:
        length = int.from_bytes(block[at + 3 : at + 5])
        if length & 0x8000:  # of a length; nothing that is taken over is that long
            return
        yield block[at + 1], block[at + 2], block[at + 5 : at + 5 + length]
        at += 5 + length


def _decoded(content: bytes, is_utf8: bool) -> str:
    """The text; cameras and old programs do not say in which code they wrote it."""
    try:
        said = content.decode()
    except UnicodeDecodeError:
        said = content.decode(errors="replace") if is_utf8 else content.decode("cp1252", errors="replace")
    return _NO_XML.sub("", said).strip()


def _element(name: str, texts: Iterable[str], kind: str = "") -> Element:
    """A property: of one text, or an array."""
    element = Element(name)
    if not kind:
        element.text = "".join(texts)
        return element
    array = ElementTree.SubElement(element, f"{_RDF}{kind}")
    for said in texts:
        item = ElementTree.SubElement(array, f"{_RDF}li")
        item.text = said
        if kind == "Alt":
            item.set(_LANG, "x-default")
    return element
