"""For MkDocs: links of pages to files that are no pages (../scenes/hang.py) work on GitHub, and are plain text here."""

import re
from typing import Any


def on_page_markdown(markdown: str, **_: Any) -> str:
    return re.sub(r"\[([^\[\]]+)\]\(\.\./[^)\s]+\)", r"\1", markdown)
