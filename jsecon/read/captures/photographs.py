"""Photographs of a folder, on the host."""

import re
from pathlib import Path

from jsecon.files import list_files
from jsecon.read.captures.images import IMAGE_SUFFIXES

_OTHER_IMAGES = re.compile(r"mask|depth|segmentation|proposal|label|confidence|normal|thumb")
"""in the name of a folder whose images are not photographs"""


def list_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder, or of its images/, in name order.

    If none lies directly in the folder, those of its subfolders are listed (cam0/, cam1/), except in folders of masks
    or depth, masks named like the photograph beside them (a.jpg.png), and output of jsecon.
    """
    folder = path / "images" if (path / "images").is_dir() else path
    if not folder.is_dir():
        return []
    direct = sorted(file for file in folder.iterdir() if _is_image(file) and file.is_file())
    if direct:
        return direct
    images = [file for file in list_files(folder) if _is_image(file)]
    masked = {image.with_suffix("") for image in images}.intersection(images)
    return [
        file
        for file in images
        if file.with_suffix("") not in masked
        and not any(_OTHER_IMAGES.search(part.lower()) for part in file.relative_to(folder).parts[:-1])
    ]


def _is_image(file: Path) -> bool:
    """Whether a file is named like a visible image."""
    return file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
