"""The table of docs/how-to/tls.md, who may do what: each of its cells is a test."""

from tests.conftest import ROOT

TOKENS = {"camera:cam00": "a camera's", "viewer": "a viewer's", "operator": "an operator's"}
"""Token by name. Whoever calls with none of them is "nobody"."""


def cells() -> list[tuple[str, str, bool]]:
    """What is done, who does it (a name of TOKENS, or "nobody"), whether they may."""
    lines = iter((ROOT / "docs" / "how-to" / "tls.md").read_text().splitlines())
    while next(lines) != "| | camera | viewer | operator | nobody |":
        pass
    next(lines)
    found = []
    for line in lines:
        if not line.startswith("|"):
            return found
        what, *answers = (cell.strip() for cell in line.strip("|").split("|"))
        found += [(what, who, {"yes": True, "no": False}[a]) for who, a in zip([*TOKENS, "nobody"], answers)]
    raise AssertionError("the table has no end")


def cells_of(prefix: str) -> list[tuple[str, str, bool]]:
    return [cell for cell in cells() if cell[0].startswith(prefix)]
