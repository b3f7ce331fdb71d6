"""Which files a scan may refer to, and how they are found: one rule for MTL, PLY and glTF."""

import os
import unicodedata
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from scan2albedo.errors import ScanError
from scan2albedo.io.images import SUPPORTED_IMAGES

_CODE_PAGES = ("cp1252", "cp932", "gbk", "cp949", "cp1251", "cp437")
"""Of file names in OBJ and MTL files that are no UTF-8; the file that exists decides which it is."""


@dataclass(frozen=True)
class ScanFolder:
    """The files that a scan may refer to: those in its folder and, where given, in the folder `textures`.

    Links that lead elsewhere lead to none of these files. Raises ScanError when `textures` is not a folder.
    """

    path: Path
    textures: Path | None = None

    def __post_init__(self) -> None:
        if self.textures is not None and not os.path.isdir(self.textures):
            raise ScanError(f"{self.textures}: is not a folder; give the folder that holds the textures")

    def find(self, name: str) -> Path | None:
        """Return a file by its path or name, in any case, code page and Unicode form, or None."""
        spellings = [name]
        if any("\udc80" <= letter <= "\udcff" for letter in name):  # not UTF-8
            data = name.encode("utf-8", "surrogateescape")
            spellings += [data.decode(page, "replace") for page in _CODE_PAGES]
        for spelling in spellings:
            relative = Path(spelling.replace("\\", "/"))
            wanted = _folded(relative.name)
            try:
                for home in filter(None, (self.path, self.textures)):
                    folders = dict.fromkeys((home / relative.parent, home))
                    places = [place for place in folders if self._allows(place)]
                    named = (place / relative.name for place in places)
                    others = (file for place in places if place.is_dir() for file in sorted(place.iterdir()))
                    for file in chain(named, (file for file in others if _folded(file.name) == wanted)):
                        if file.is_file() and self._allows(file):
                            return file
            except (OSError, ValueError):  # a name that no file may have, a folder that may not be read
                continue
        return None

    def library_names(self, words: str) -> list[str]:
        """Return the files of a `mtllib` line: one name with spaces if there is such a file, else several."""
        return [words] if not words or self.find(words) else words.split()

    def or_named_like(self, scan: Path, textures: list[str]) -> list[str]:
        """Return names of textures, where none exists also those that an image of the scan may have."""
        lost = all(self.find(name) is None for name in textures)
        return textures + ([scan.stem + extension for extension in SUPPORTED_IMAGES] if lost else [])

    def why_missing(self, name: str) -> str:
        """Return why `find` returns None, as the end of a sentence."""
        if os.path.isfile(self.path / name.replace("\\", "/")):
            return "lies outside the scan's folder, and only --textures (in Python: textures) allows another"
        return "is missing beside the scan (--textures names another folder to look in)"

    def _allows(self, path: Path) -> bool:
        homes = (self.path, self.textures)
        real = path.resolve()
        return any(home is not None and real.is_relative_to(home.resolve()) for home in homes)


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
