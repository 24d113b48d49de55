"""Sentences in lines."""

import re
import textwrap


def fill(sentence: str, width: int) -> str:
    """Break a sentence into lines, no number from its unit and no interval apart."""
    kept = re.sub(r"\[[^\]]*\]| %| ns\b", lambda found: found[0].replace(" ", "\xa0"), sentence)
    return textwrap.fill(kept, width, break_on_hyphens=False).replace("\xa0", " ")
