"""What was made from what, remembered beside the panoramas, so that it need not be made again.

``.abflow/pano.pto.json`` in the panorama's folder holds hashes of the project, of its photos and layers, and
of the panorama, the settings and the version. It is written when the panorama is complete, so what a killed
run began does not count.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from hugin_abflow.batch.record import Record, write_json
from hugin_abflow.errors import AbflowError, ImageReadError
from hugin_abflow.found import layers_there
from hugin_abflow.images import image_size, read_layers
from hugin_abflow.jpeg import is_cut
from hugin_abflow.metadata import version
from hugin_abflow.outputs import checked_outputs, impossible, possible_outputs
from hugin_abflow.project import read_plan

_log = logging.getLogger(__name__)

SCHEMA = 1
FOLDER = ".abflow"
# Options that do not change the panorama, but how and where it is made.
RESOURCES = frozenset({"device", "band_rows", "remap", "threads", "max_memory"})
_ROWS = 256  # that are decoded at a time

Entry = dict[str, Any]


class State:
    """The memory of one project.

    project     its file. options: keywords of `stitch_project`. settings: all options as plain values.

    Raises the `AbflowError` family for a project that cannot be read.
    """

    def __init__(self, project: Path, options: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
        self._plan = read_plan(project)
        self._options = options
        self._settings = {name: value for name, value in settings.items() if name not in RESOURCES}
        output = options.get("output")
        self._folder = self._plan.folder if output is None else Path(output).absolute().parent
        name = self._plan.file.name if output is None else Path(output).name
        self.file = self._folder / FOLDER / f"{name}.json"
        self._known = self._load()
        self._inputs: list[Entry] = []
        self._noted: list[Entry] = []

    def inputs(self) -> list[Path]:
        """The project, its photos and the layers that would be used, as far as they are there now."""
        options = self._options
        layers = layers_there(
            self._plan, options.get("prefix"), options.get("layers"), options.get("remap", "auto")
        )
        files = [self._plan.file, *(image.photo for image in self._plan.images), *layers]
        return [file for file in dict.fromkeys(file.absolute() for file in files) if file.is_file()]

    def begin(self) -> None:
        """Remember the inputs as they are now: what changes while the panorama is made does not count."""
        self._inputs = self._entries(self.inputs(), self._known.get("inputs", []))

    def restore(self, record: Record) -> bool:
        """Make `record` that of what was made before, if project, inputs, settings and version are still the
        same and the panorama is there. So too, with a warning, if somebody changed it since, whatever else
        changed: nobody's work is lost unasked. Else do nothing. `begin` comes first.
        """
        known = self._known
        try:
            if known["schema"] != SCHEMA:
                return False
            found = [(entry, self._look(entry)) for entry in known["outputs"]]
            there = [entry for entry, how in found if how != "gone"]
            holds = bool(found) and len(there) == len(found) and known["hash"] == self._hash()
            if set(known.get("left_out", [])) - set(self._left_out()):
                holds = False  # its program has been installed
            # layers are inputs as well; such as somebody changed are used, and replaced by none
            inputs = set() if holds else {entry["file"] for entry in self._inputs}
            changed = [
                entry["file"] for entry, how in found if how == "changed" and entry["file"] not in inputs
            ]
            if not (holds or changed):
                return False
            outputs, device, overlaps = self._plain(there), known["device"], known["overlaps"]
            if not (isinstance(device, str) and isinstance(overlaps, list)):
                return False
        except (KeyError, TypeError, ValueError, OverflowError):  # damaged, or written by somebody else
            return False
        record.outputs, record.device, record.overlaps = outputs, device, overlaps
        also = "" if holds else ", and so were project, photos, layers, settings or another output"
        for name in changed:
            _log.warning(
                "%s was changed since it was made%s; it is left as it is (--force makes it anew)",
                self._folder / name, also,
            )  # fmt: skip
        if self._left_out():
            possible_outputs(self._plan)  # warns of them
        record.result = "skipped"
        return True

    def note(self, file: Path) -> None:
        """Remember that an output was made just now, though not yet of what: where the run is killed, or is
        not to be remembered, it is not taken for one that somebody changed.
        """
        with suppress(OSError, KeyError, TypeError):  # it cannot be written, or somebody else wrote it
            if self._known:
                self._noted += self._entries([file], [])
                ours = {entry["file"] for entry in self._noted}
                others = [entry for entry in self._known["outputs"] if entry["file"] not in ours]
                write_json(self.file, self._known | {"hash": "", "outputs": others + self._noted})

    def save(self, record: Record) -> None:
        """Remember what was made. A folder that takes no memory is worth a warning."""
        kept = {entry["file"] for entry in self._inputs}
        new = [file for file in self.inputs() if self._name(file) not in kept]
        try:
            self._inputs += self._entries(new, [])  # layers that were made and kept
            for file in record.files:
                _flush(file)
            self.file.parent.mkdir(exist_ok=True)
            values = {
                "schema": SCHEMA,
                "hash": self._hash(),
                "version": version(),
                "made": record.started,
                "device": record.device,
                "settings": self._settings,
                "inputs": self._inputs,
                "outputs": self._entries(record.files, self._noted),
                "left_out": self._left_out(),
                "overlaps": record.overlaps,
            }
            write_json(self.file, values)
        except OSError as error:
            _log.warning(
                "%s cannot be written (%s): %s will be made again", self.file, error, self._plan.file
            )

    def _left_out(self) -> list[str]:
        """Outputs that are checked in the project, but lack a program here."""
        if any(self._options.get(name) for name in ("output", "prefix", "layers")):
            return []
        return sorted(impossible(checked_outputs(self._plan)))

    def _load(self) -> dict[str, Any]:
        """What was remembered; nothing if it is unreadable."""
        with suppress(OSError, ValueError, RecursionError):
            known = json.loads(self.file.read_text("utf-8"))
            if isinstance(known, dict) and isinstance(known.get("inputs"), list):
                return known
        return {}

    def _hash(self) -> str:
        """Of all that the panorama depends on."""
        inputs = sorted((entry["file"], entry["blake2b"]) for entry in self._inputs)
        text = json.dumps([version(), self._settings, inputs], sort_keys=True, default=str)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _name(self, file: Path) -> str:
        """A file's name as it is remembered: the whole folder may be moved."""
        try:
            return Path(os.path.relpath(file, self._folder)).as_posix()
        except ValueError:  # another drive
            return file.as_posix()

    def _entries(self, files: Iterable[Path], known: Iterable[Entry]) -> list[Entry]:
        """Names, sizes, times and hashes of files. What is unchanged by size and time is not read again."""
        before = {str(entry.get("file")): entry for entry in known if isinstance(entry, dict)}
        entries = []
        for file in files:
            status, name = file.stat(), self._name(file)
            entry = {"file": name, "bytes": status.st_size, "mtime_ns": status.st_mtime_ns}
            old = before.get(name, {})
            if isinstance(old.get("blake2b"), str) and entry.items() <= old.items():
                entry["blake2b"] = old["blake2b"]
            else:
                entry["blake2b"] = _digest(file)
            entries.append(entry)
        return entries

    def _plain(self, entries: Iterable[Entry]) -> list[Entry]:
        """Entries as they stand in records."""
        return [
            {"file": str(Path(os.path.normpath(self._folder / entry["file"]))), "bytes": int(entry["bytes"])}
            for entry in entries
        ]

    def _look(self, entry: Entry) -> Literal["made", "changed", "gone"]:
        """Whether an output is there as it was made, or as somebody changed it; a damaged one is gone."""
        file = self._folder / entry["file"]
        if not file.is_file():
            return "gone"
        if self._entries([file], [entry])[0]["blake2b"] == entry["blake2b"]:
            return "made"
        return "changed" if _decodes(file) else "gone"


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _flush(file: Path) -> None:
    """Have the system write a file to the disk, so that no power cut loses what is remembered as made."""
    # for writing where it has to be; elsewhere that would refuse panoramas that are not to be written
    with file.open("rb+" if os.name == "nt" else "rb") as stream:
        os.fsync(stream.fileno())


def _decodes(file: Path) -> bool:
    """Whether an image can be decoded to its end; of what no layer can be, whether it can be opened."""
    if is_cut(file):
        return False
    try:
        layers = read_layers(file)
    except ImageReadError:  # somebody's in CMYK, of 1 bit ..., which no layer is, and none of ours
        return image_size(file) is not None
    try:
        for layer in layers:
            for top in range(0, layer.box.height, _ROWS):
                layer.read(top, min(top + _ROWS, layer.box.height))
    except AbflowError:
        return False
    return True
