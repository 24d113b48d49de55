"""README's numbers: it is shown as it stands, so what it has of the records is copied into it, and tested.

A number stands between comments that no reader sees, ``<!-- value: PATH -->-43.6 %<!-- end -->``, with ``number`` in
place of ``value`` where its interval is shown too. Paths are those of :mod:`sentence_numbers`.
"""

import re
from pathlib import Path

from sentence_numbers import number_text

NUMBER = re.compile(r"(<!-- (value|number): (\S+(?: \S+)*?) -->).*?(<!-- end -->)", re.S)


def with_numbers(page: Path) -> str:
    """Return the text of a page with every number as its record has it.

    Raises:
        ValueError: if there is no such page, it holds no number of a record, or a path leads nowhere.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not NUMBER.search(text):
        raise ValueError(f"{page} holds no number of a record, such as <!-- value: PATH --><!-- end -->")
    return NUMBER.sub(lambda m: m[1] + number_text(m[3], interval=m[2] == "number") + m[4], text)
