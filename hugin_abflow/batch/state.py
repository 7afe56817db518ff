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
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hugin_abflow.asked import asked_panoramas, is_more_asked, names_one
from hugin_abflow.batch.record import Record, write_json
from hugin_abflow.errors import AbflowError, ImageReadError
from hugin_abflow.found import layers_there
from hugin_abflow.images import image_size, read_layers
from hugin_abflow.jpeg import is_cut
from hugin_abflow.metadata import saved_by, version
from hugin_abflow.outputs import checked_outputs, impossible, possible_outputs, results
from hugin_abflow.project import read_plan

_log = logging.getLogger(__name__)

SCHEMA = 1
FOLDER = ".abflow"
# Options that do not change the panorama, but how and where it is made.
RESOURCES = frozenset({"device", "band_rows", "remap", "threads", "max_memory"})
_ROWS = 256  # that are decoded at a time

Entry = dict[str, Any]
_Look = Literal["made", "changed", "gone"]


@dataclass(frozen=True)
class _Verdict:
    """What is to be thought of the outputs that are there.

    same    project, inputs, settings and version are as they were when they were made.
    holds   so are all outputs, but for what somebody changed: there is nothing to make.
    shown   those that are there. left: of these, such as somebody changed, or another program saved.
    """

    same: bool
    holds: bool
    shown: list[Entry]
    left: list[Entry]


class State:
    """The memory of one project.

    project     its file. options: keywords of `stitch_project`. settings: all options as plain values.
    left        outputs that must not be replaced; known after `restore`, whether or not there is anything to
                make.

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
        self._left: list[Entry] = []

    @property
    def left(self) -> list[Path]:
        """Outputs that somebody changed, or another program made."""
        return [self._file(entry) for entry in self._left]

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
        same and the panorama is there. So too if there is nothing to be made but what is in `left`: what
        somebody changed since, or another program saved, is left, with a warning, whatever else changed.
        Nobody's work is lost unasked. Else return False; `left` is known then, too. `begin` comes first.
        """
        verdict = self._judge()
        for entry in verdict.left:
            self._warn(entry, verdict.same)
        # where the others are made anew, even what it was before somebody changed it is out of date
        self._left = [entry if verdict.same else {**entry, "blake2b": ""} for entry in verdict.left]
        if not verdict.holds and (not self._left or is_more_asked(self._plan, self._options, self.left)):
            return False
        record.outputs = self._plain(verdict.shown)
        record.device, record.overlaps = self._known.get("device", ""), self._known.get("overlaps", [])
        if self._left_out():
            possible_outputs(self._plan)  # warns of them
        record.result = "skipped"
        return True

    def _judge(self) -> _Verdict:
        """What is to be thought of the outputs that are there; nobody is told."""
        asked = self._asked()
        # what somebody changed and nobody asks for any more is not ours: no run would make it anew
        found = [(entry, how) for entry, how in self._found() if how != "changed" or entry["file"] in asked]
        there = [entry for entry, how in found if how != "gone"]
        changed = [entry for entry, how in found if how == "changed"]
        same = bool(found) and self._known["hash"] == self._hash()
        # what was left out is to be made once its program is installed
        if same and len(there) == len(found) and set(self._known["left_out"]) <= set(self._left_out()):
            return _Verdict(same, True, there, changed)
        # layers are inputs as well; such as somebody changed are used, and replaced by none
        inputs = {entry["file"] for entry in self._inputs}
        foreign = self._foreign({entry["file"] for entry, _ in found} | inputs)
        changed = [entry for entry in changed if entry["file"] not in inputs]
        return _Verdict(same, False, there + foreign, changed + foreign)

    def _found(self) -> list[tuple[Entry, _Look]]:
        """The outputs that were made, and what became of them; nothing, and nothing is known any more, where
        that is damaged, or written by somebody else.
        """
        known = self._known
        with suppress(KeyError, TypeError, ValueError, OverflowError):
            found = [(entry, self._look(entry)) for entry in known["outputs"]]
            self._plain(entry for entry, _ in found)
            texts = [known["device"], known["hash"], *known.setdefault("left_out", [])]
            whole = isinstance(known["overlaps"], list) and all(isinstance(one, str) for one in texts)
            if known["schema"] == SCHEMA and whole:
                return found
        self._known = {}
        return []

    def _asked(self) -> set[str]:
        """Names of the outputs that are asked for now, whether or not they can be made here."""
        files = asked_panoramas(self._plan, **self._options)
        if not names_one(self._options):
            files += results(self._plan, keep_layers=False)
        return {self._name(file) for file in files}

    def _foreign(self, known: Collection[str]) -> list[Entry]:
        """Panoramas that would be replaced, of which nothing is known, and which another program saved."""
        files = [file for file in asked_panoramas(self._plan, **self._options) if saved_by(file)]
        unknown = [file for file in files if self._name(file) not in known and _decodes(file)]
        return [{**entry, "blake2b": ""} for entry in self._entries(unknown, [])]

    def _warn(self, entry: Entry, same: bool) -> None:
        """Tell of an output that is left; same: project, inputs, settings and version are as they were."""
        file = self._file(entry)
        if not entry["blake2b"] and (program := saved_by(file)):
            what = f"was saved by {program}"  # which is all that is known of it
        else:
            what = "was changed since it was made"
            what += "" if same else ", and so were project, photos, layers or settings"
        extra = {"left": str(file)}  # by which a display knows that it has told so before
        _log.warning("%s %s; it is left as it is (--force makes it anew)", file, what, extra=extra)

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
            made = [file for file in record.files if file not in self.left]
            for file in made:
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
                "outputs": self._entries(made, self._noted) + self._left,
                "left_out": self._left_out(),
                "overlaps": record.overlaps,
            }
            write_json(self.file, values)
        except OSError as error:
            why = error.strerror  # without the name of a temporary file
            _log.warning("%s cannot be written (%s): %s will be made again", self.file, why, self._plan.file)

    def _left_out(self) -> list[str]:
        """Outputs that are checked in the project, but lack a program here."""
        return [] if names_one(self._options) else sorted(impossible(checked_outputs(self._plan)))

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
        return [{"file": str(self._file(entry)), "bytes": int(entry["bytes"])} for entry in entries]

    def _file(self, entry: Entry) -> Path:
        """The file that an entry is about."""
        return Path(os.path.normpath(self._folder / entry["file"]))

    def _look(self, entry: Entry) -> _Look:
        """Whether an output is there as it was made, or as somebody changed it; a damaged one is gone."""
        file = self._folder / entry["file"]
        if not file.is_file():
            return "gone"
        if entry["blake2b"] and self._entries([file], [entry])[0]["blake2b"] == entry["blake2b"]:
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
