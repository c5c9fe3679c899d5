"""Tables of a take's marker labels and what an attachment calls them."""

import csv
import io
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.tables.csv_table import quoted

HEADER = ("take", "attachment")
_MAX_BYTES = 2**22


def load_label_map(path: str | Path) -> dict[str, str]:
    """Reads CSV of two columns, the take's label and the attachment's::

        take,attachment
        LBrowIn,M001
        helmet_front,
        Jane:*,

    The heading may be left out; an empty second cell leaves the marker out, or all markers of a subject.
    """
    path = Path(path)
    try:
        rows = list(csv.reader(io.StringIO(read_file(path, _MAX_BYTES).decode("utf-8-sig"), newline="")))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: no table of labels ({error}), expected rows of take,attachment") from error
    renamed: dict[str, str] = {}
    for number, row in enumerate(rows, 1):
        cells = [cell.strip() for cell in row]
        if not any(cells) or (number == 1 and tuple(cell.lower() for cell in cells) == HEADER):
            continue
        if len(cells) != 2 or not cells[0]:
            raise FileFormatError(
                f"{path}: row {number}: found {quoted(cells)}, expected two cells: a label of the take, and the "
                "attachment's"
            )
        if cells[0] in renamed:
            raise FileFormatError(f"{path}: row {number}: found {cells[0]!r} again, expected each label once")
        renamed[cells[0]] = cells[1]
    if not renamed:
        raise FileFormatError(f"{path}: found no row, expected a label of the take and of the attachment in each")
    return renamed
