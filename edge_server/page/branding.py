"""The page's title, icon and styles, which replace viser's."""

from __future__ import annotations

import gzip
import re
from functools import cache
from pathlib import Path
from urllib.parse import quote

TITLE = "freshfield"
_ICON = (
    "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'><rect width='32' height='32' rx='7' fill='#141820'/>"
    "<path d='M6 24q10-12 20 0' fill='none' stroke='#2dd4a4' stroke-width='3'/>"
    "<path d='M6 18q10-12 20 0' fill='none' stroke='#facc3c' stroke-width='3' opacity='.8'/>"
    "<path d='M6 12q10-12 20 0' fill='none' stroke='#e0532f' stroke-width='3' opacity='.6'/></svg>"
)


@cache
def branded(document: bytes, packed: bool) -> bytes:
    """viser's HTML document with the title, the icon and ``page.css``. packed: it is, and stays, compressed (gzip)."""
    text = (gzip.decompress(document) if packed else document).decode()
    text = re.sub(r"<title>.*?</title>|<link\s[^>]*rel=\"icon\"[^>]*>", "", text)
    css = (Path(__file__).parent / "page.css").read_text()
    head = f'<title>{TITLE}</title><link rel="icon" href="data:image/svg+xml,{quote(_ICON)}"><style>{css}</style>'
    found = text.replace("</head>", f"{head}</head>", 1).encode()
    return gzip.compress(found) if packed else found
