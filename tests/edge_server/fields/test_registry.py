"""Fields by name: lazily imported, options checked."""

import re
from typing import Any

import pytest

from edge_server.fields import Budget
from edge_server.fields.registry import make_field, option_help
from tests.edge_server.fields.small import CLASSES, every_field

# A value, and what is said of it.
REFUSED: list[tuple[str, Any, str]] = [
    ("radius_m", float("nan"), "a number"),
    ("background", "pink", "#80c0ff"),
    ("center_m", [1, 2], "a list of 3"),
    ("threads", 0, "1 to 1024"),
    ("levles", 3, "no option levles; it has: "),
    ("rate_net", 0.1, "no option rate_net; it has: "),  # a tuned number, no option
]


@every_field
def test_a_field_has_its_options_and_what_it_cannot_work_with_is_refused_by_name(name: str) -> None:
    field: Any = make_field(name, {"center_m": [1, 2, 3], "radius_m": None}, seed=5)
    assert type(field) is CLASSES[name] and field.settings.seed == 5
    assert (field.settings.center_m, field.settings.radius_m) == ((1.0, 2.0, 3.0), None)
    known = option_help(name)
    assert len(known) <= 20 and all(len(text) > 10 for text in known.values())
    for option, value, text in REFUSED:
        with pytest.raises(ValueError, match=f"^{name}.*{re.escape(text)}") as refused:
            make_field(name, {option: value})
        assert option in str(refused.value)


@pytest.mark.parametrize("wrong", [{"seconds": float("nan")}, {"steps": -1}, {}])
def test_a_budget_without_an_end_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="a budget is"):
        Budget(**wrong)
